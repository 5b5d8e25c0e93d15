// One corner of a Gaussian's quad, from the data textures. An instance draws a batch of quads: instances of one quad each
// are slow on many devices.
#include "splat.glsl"

uniform usampler2D geometry;    // the file's bits (docs/web.md): x and opacity; y, z, each with a byte of the third scale; quaternion
uniform usampler2D scales;      // the first two, 16 bits each
uniform sampler2D colors;
uniform usampler2D order;       // indices of the Gaussians, view by view, farthest first
uniform ivec2 segment;          // of the order: first place and count
uniform vec2 color_range;       // the colours of the bytes 0 and 255
uniform vec3 sides[4];          // inward unit normals of the view frustum, camera axes
uniform vec4 window;            // centre and half the size of the image, image plane

flat out vec2 v_base;
flat out vec4 v_a;
flat out vec4 v_b;
flat out vec4 v_l;
flat out vec3 v_color;

// Whether a ball around the Gaussian's visible part is on the outer side of one of the frustum's sides. This rejects
// most Gaussians before the projection.
bool is_ball_outside(vec3 mean, float opacity, vec3 scale) {
    vec3 offset = mean - position;
    vec3 center = world_to_camera * offset;
    float reach = sqrt(2.0 * log(max(opacity / ALPHA_CUT, 1.0)));
    float largest = max(scale.x, max(scale.y, scale.z));
    float radius = 1.001 * reach * (largest + sqrt(filter_variance) * length(offset) + length(shift) / EXPOSURE_WAY) + 1e-5 * length(offset);
    for (int i = 0; i < 4; i++) {
        if (dot(sides[i], center) < -radius) return true;
    }
    return false;
}

// Whether the visible cone of the Gaussian is on the outer side of one of the frustum's sides: docs/rendering.md,
// section 5. The quad of a Gaussian that crosses the camera's plane covers the whole image, so this test matters.
bool is_cone_outside(Gaussian gaussian, Footprint f) {
    vec3 n = world_to_camera * ((gaussian.mean - position) / f.distance);
    mat3 unit = world_to_camera * rotation_from_quat(gaussian.quat);
    vec3 k = gaussian.scale / f.distance, m = find_motion(n, f.distance);
    float kappa = 2.0 * log(f.peak / ALPHA_CUT) + 1e-3;
    for (int i = 0; i < 4; i++) {
        float height = dot(sides[i], n);
        vec3 across = (sides[i] * unit) * k;
        float motion = dot(sides[i], m);
        float variance = dot(across, across) + filter_variance * (1.0 - height * height) + motion * motion;
        if (height < 0.0 && height * height > kappa * variance) return true;
    }
    return false;
}

// A unit quaternion from the index of its largest component, and the others with 10 bits each.
vec4 unpack_quat(uint word) {
    vec3 rest = (vec3(uvec3(word >> 20, word >> 10, word) & 1023u) / 511.0 - 1.0) * 0.70710678;
    float largest = sqrt(max(1.0 - dot(rest, rest), 0.0));
    uint index = word >> 30;
    if (index == 0u) return vec4(largest, rest);
    if (index == 1u) return vec4(rest.x, largest, rest.yz);
    return index == 2u ? vec4(rest.xy, largest, rest.z) : vec4(rest, largest);
}

void main() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside the image
    v_base = vec2(0.0);
    v_a = v_b = v_l = vec4(0.0);
    v_color = vec3(0.0);
    int place = gl_InstanceID * BATCH + (gl_VertexID >> 2);
    if (place >= segment.y) return;
    place += segment.x;
    int width = textureSize(colors, 0).x;
    int index = int(texelFetch(order, ivec2(place % width, place / width), 0).r);
    ivec2 texel = ivec2(index % width, index / width);
    uvec4 words = texelFetch(geometry, texel, 0);
    uint pair = texelFetch(scales, texel, 0).r;
    vec3 mean = uintBitsToFloat(words.xyz & 0xffffff00u);
    vec3 scale = uintBitsToFloat(uvec3(pair & 0xffff0000u, pair << 16, (words.y & 255u) << 24 | (words.z & 255u) << 16));
    float opacity = float(words.x & 255u) / 255.0;
    if (is_ball_outside(mean, opacity, scale)) return;
    Gaussian gaussian = Gaussian(mean, opacity, unpack_quat(words.w), scale);
    Footprint f;
    if (!project_gaussian(gaussian, f) || is_cone_outside(gaussian, f)) return;
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2.0 - 1.0;
    vec2 screen = (f.center + corner.x * f.half_axis_1 + corner.y * f.half_axis_2 - window.xy) / window.zw;
    gl_Position = vec4(screen.x, -screen.y, 0.0, 1.0);
    v_base = f.base;
    v_a = vec4(f.a, f.thickness);
    v_b = vec4(f.b, f.distance);
    v_l = vec4(f.l, f.peak);
    v_color = mix(color_range.xxx, color_range.yyy, texelFetch(colors, texel, 0).rgb);
}
