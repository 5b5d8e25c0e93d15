"""Surface finishes of the generated rooms as Cycles node materials.

Every finish is a function of the position in the room (metres). It needs no UV map and does not repeat: a periodic
pattern matches at many disparities. All finishes are rough, because a mirror has no depth.
"""

from __future__ import annotations

import math
from pathlib import Path

import bpy

Color = tuple[float, float, float]


class MaterialGraph:
    """The node graph of a new material."""

    def __init__(self, name: str, roughness: float = 0.8, specular: float = 0.2) -> None:
        self.material = bpy.data.materials.new(name)
        self.material.use_nodes = True
        self.nodes, self.links = self.material.node_tree.nodes, self.material.node_tree.links
        self.surface = self.nodes["Principled BSDF"]
        self.surface.inputs["Roughness"].default_value = roughness
        self.surface.inputs["Specular IOR Level"].default_value = specular
        self.position = self.add("ShaderNodeTexCoord").outputs["Object"]

    def add(self, kind: str, **inputs: object) -> bpy.types.Node:
        """Add a node. Inputs are values or outputs of other nodes; underscores in their names stand for spaces."""
        node = self.nodes.new(kind)
        for name, value in inputs.items():
            socket = node.inputs[name.replace("_", " ")]
            if isinstance(value, bpy.types.NodeSocket):
                self.links.new(value, socket)
            else:
                socket.default_value = value
        return node

    def stretch_position(self, scale: Color, turn: float = 0.0) -> bpy.types.NodeSocket:
        """The position, rotated about z by `turn` radians and scaled per axis."""
        node = self.add("ShaderNodeMapping", Vector=self.position, Scale=scale, Rotation=(0.0, 0.0, turn))
        return node.outputs["Vector"]

    def noise(self, vector: bpy.types.NodeSocket, scale: float, detail: float = 6.0) -> bpy.types.NodeSocket:
        """Fractal noise, mostly between 0.3 and 0.7."""
        return self.add("ShaderNodeTexNoise", Vector=vector, Scale=scale, Detail=detail, Roughness=0.6).outputs["Fac"]

    def ramp(self, value: bpy.types.NodeSocket, stops: list[tuple[float, Color]]) -> bpy.types.NodeSocket:
        """A colour ramp over a value, of at least two stops."""
        node = self.add("ShaderNodeValToRGB", Fac=value)
        elements = node.color_ramp.elements
        for _ in stops[2:]:
            elements.new(0.5)
        for element, (position, color) in zip(elements, stops, strict=True):
            element.position, element.color = position, (*color, 1.0)
        return node.outputs["Color"]

    def mix(
        self, a: bpy.types.NodeSocket, b: bpy.types.NodeSocket, mode: str = "MULTIPLY", amount: float = 1.0
    ) -> bpy.types.NodeSocket:
        """Two colours combined with a blend mode."""
        node = self.nodes.new("ShaderNodeMixRGB")
        node.blend_type = mode
        node.inputs["Fac"].default_value = amount
        self.links.new(a, node.inputs["Color1"])
        self.links.new(b, node.inputs["Color2"])
        return node.outputs["Color"]

    def bump(self, height: bpy.types.NodeSocket, distance: float) -> None:
        """Add a relief of `distance` metres."""
        node = self.add("ShaderNodeBump", Height=height, Distance=distance, Strength=0.6)
        self.links.new(node.outputs["Normal"], self.surface.inputs["Normal"])

    def finish(self, color: bpy.types.NodeSocket, mean: Color | None = None) -> bpy.types.Material:
        """The material with `color` as its base colour.

        With `mean`, indirect light uses that constant colour, which renders faster and looks the same.
        """
        self.links.new(color, self.surface.inputs["Base Color"])
        if mean is not None:
            plain = self.add("ShaderNodeBsdfDiffuse", Color=(*mean, 1.0)).outputs[0]
            mixed = self.nodes.new("ShaderNodeMixShader")
            self.links.new(self.nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"], mixed.inputs[0])
            self.links.new(plain, mixed.inputs[1])
            self.links.new(self.surface.outputs[0], mixed.inputs[2])
            self.links.new(mixed.outputs[0], self.nodes["Material Output"].inputs["Surface"])
        return self.material


def _scale_color(color: Color, factor: float) -> Color:
    return tuple(min(1.0, c * factor) for c in color)


def plaster(color: Color, contrast: float = 0.22) -> bpy.types.Material:
    """Limewashed wall: cloudy colours with brush strokes."""
    g = MaterialGraph("plaster", roughness=0.9, specular=0.1)
    clouds = g.noise(g.position, 1.7, 9.0)
    brushed = g.noise(g.stretch_position((5.0, 5.0, 14.0)), 1.6, 4.0)
    wide = g.ramp(clouds, [(0.3, _scale_color(color, 1 - contrast)), (0.7, _scale_color(color, 1 + contrast))])
    fine = g.ramp(brushed, [(0.3, (0.84, 0.83, 0.82)), (0.62, (1.0, 1.0, 1.0))])
    g.bump(brushed, 0.004)
    return g.finish(g.mix(wide, fine), _scale_color(color, 0.94))


def wood(color: Color, axis: int = 0, fineness: float = 1.0) -> bpy.types.Material:
    """Grained wood whose fibres run along `axis` (0 x, 1 y, 2 z)."""
    g = MaterialGraph("wood", roughness=0.55, specular=0.25)
    scale = [9.0 * fineness] * 3
    scale[axis] = 0.7 * fineness
    grain = g.noise(g.stretch_position(tuple(scale)), 2.2, 8.0)
    dark, light = _scale_color(color, 0.45), _scale_color(color, 1.35)
    tone = g.ramp(grain, [(0.28, dark), (0.5, color), (0.58, _scale_color(color, 0.8)), (0.75, light)])
    g.bump(grain, 0.002)
    return g.finish(tone, _scale_color(color, 0.85))


def planks(color: Color, length: float = 1.35, width: float = 0.13, spread: float = 0.4) -> bpy.types.Material:
    """Long boards along x; the brightness of each is 1 - `spread` to 1 + `spread` of the colour."""
    g = MaterialGraph("planks", roughness=0.75, specular=0.12)
    low, high = (1 - spread,) * 3, (1 + spread,) * 3
    brick = g.add(
        "ShaderNodeTexBrick", Vector=g.position, Scale=1.0, Mortar_Size=0.0035, Bias=0.0, Brick_Width=length,
        Row_Height=width, Color1=(*low, 1), Color2=(*high, 1), Mortar=(0.12, 0.1, 0.09, 1),
    )  # fmt: skip
    brick.offset, brick.offset_frequency = 0.37, 2
    grain = g.noise(g.stretch_position((1.1, 16.0, 4.0)), 2.0, 9.0)
    tone = g.ramp(
        grain, [(0.3, _scale_color(color, 1 - spread)), (0.52, color), (0.72, _scale_color(color, 1 + 0.7 * spread))]
    )
    stain = g.ramp(g.noise(g.position, 0.9, 5.0), [(0.35, (0.8, 0.78, 0.76)), (0.65, (1.0, 1.0, 1.0))])
    return g.finish(g.mix(g.mix(tone, brick.outputs["Color"]), stain), _scale_color(color, 0.82))


def bricks(light: Color, dark: Color) -> bpy.types.Material:
    """Brick wall along x or y; bricks differ in tone."""
    g = MaterialGraph("bricks", roughness=0.95, specular=0.05)
    split = g.add("ShaderNodeSeparateXYZ", Vector=g.position)
    along = g.add("ShaderNodeMath")
    g.links.new(split.outputs["X"], along.inputs[0])
    g.links.new(split.outputs["Y"], along.inputs[1])
    face = g.add("ShaderNodeCombineXYZ", X=along.outputs[0], Y=split.outputs["Z"])
    brick = g.add(
        "ShaderNodeTexBrick", Vector=face.outputs[0], Scale=1.0, Mortar_Size=0.008, Brick_Width=0.24,
        Row_Height=0.077, Color1=(*light, 1), Color2=(*dark, 1), Mortar=(0.55, 0.5, 0.45, 1),
    )  # fmt: skip
    dirt = g.ramp(g.noise(g.position, 6.0, 8.0), [(0.3, (0.6, 0.58, 0.55)), (0.65, (1.05, 1.05, 1.05))])
    return g.finish(
        g.mix(brick.outputs["Color"], dirt), tuple((a + b) * 0.45 for a, b in zip(light, dark, strict=True))
    )


def fabric(color: Color, contrast: float = 0.35, grain: float = 90.0) -> bpy.types.Material:
    """Woven cloth: mottled yarn and worn areas."""
    g = MaterialGraph("fabric", roughness=0.95, specular=0.05)
    yarn = g.noise(g.position, grain, 3.0)
    wear = g.noise(g.position, 4.0, 6.0)
    fine = g.ramp(yarn, [(0.35, _scale_color(color, 1 - contrast)), (0.65, _scale_color(color, 1 + contrast))])
    wide = g.ramp(wear, [(0.32, (0.72, 0.7, 0.7)), (0.66, (1.0, 1.0, 1.0))])
    g.bump(yarn, 0.002)
    return g.finish(g.mix(fine, wide), _scale_color(color, 0.88))


def leather(color: Color) -> bpy.types.Material:
    """Leather with lighter worn patches."""
    g = MaterialGraph("leather", roughness=0.55, specular=0.3)
    wear = g.noise(g.position, 5.0, 9.0)
    tone = g.ramp(wear, [(0.3, _scale_color(color, 0.5)), (0.55, color), (0.75, _scale_color(color, 1.7))])
    g.bump(g.noise(g.position, 60.0, 4.0), 0.002)
    return g.finish(tone, color)


def picture(image: bpy.types.Image) -> bpy.types.Material:
    """An image on a mesh with UV coordinates."""
    g = MaterialGraph("picture", roughness=0.8, specular=0.1)
    node = g.add("ShaderNodeTexImage", Vector=g.add("ShaderNodeTexCoord").outputs["UV"])
    node.image = image
    return g.finish(node.outputs["Color"])


def backdrop(environment: Path, strength: float, turn: float) -> bpy.types.Material:
    """The view through the windows: an HDR panorama as an emissive dome."""
    g = MaterialGraph("backdrop")
    g.nodes.remove(g.surface)
    node = g.add("ShaderNodeTexEnvironment", Vector=g.stretch_position((1.0, 1.0, 1.0), turn))
    node.image = bpy.data.images.load(str(environment))
    emission = g.add("ShaderNodeEmission", Color=node.outputs["Color"], Strength=strength)
    g.links.new(emission.outputs[0], g.nodes["Material Output"].inputs["Surface"])
    return g.material


def sky(environment: Path, strength: float, turn: float) -> None:
    """Light the scene with an HDR panorama, rotated by `turn` radians."""
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    mapping = nodes.new("ShaderNodeMapping")
    mapping.inputs["Rotation"].default_value = (0.0, 0.0, math.fmod(turn, 2 * math.pi))
    links.new(nodes.new("ShaderNodeTexCoord").outputs["Generated"], mapping.inputs["Vector"])
    node = nodes.new("ShaderNodeTexEnvironment")
    node.image = bpy.data.images.load(str(environment))
    links.new(mapping.outputs["Vector"], node.inputs["Vector"])
    links.new(node.outputs["Color"], nodes["Background"].inputs["Color"])
    nodes["Background"].inputs["Strength"].default_value = strength
    bpy.context.scene.world = world
