// Bilinear look-up in six cube faces that are stored in one texture (an atlas of three columns and two rows).
// `sample_faces` is docs/rendering.md, section 6, in float32. `atlas_uv` returns texture coordinates for the texture
// unit's filter, whose weights may have few bits; its faces have a border of one pixel.

uniform int face_size;              // pixels a side, without the border

const mat3 FACES[6] = mat3[6](      // columns right, down, forward: pansplat/geometry/cubemap.py
    mat3(1, 0, 0, 0, 1, 0, 0, 0, 1), mat3(0, 0, -1, 0, 1, 0, 1, 0, 0), mat3(-1, 0, 0, 0, 1, 0, 0, 0, -1),
    mat3(0, 0, 1, 0, 1, 0, -1, 0, 0), mat3(1, 0, 0, 0, 0, 1, 0, -1, 0), mat3(1, 0, 0, 0, 0, -1, 0, 1, 0));

int face_of(vec3 d) {
    vec3 size = abs(d);
    if (size.z >= size.x && size.z >= size.y) return d.z >= 0.0 ? 0 : 2;
    if (size.x >= size.y) return d.x >= 0.0 ? 1 : 3;
    return d.y < 0.0 ? 4 : 5;
}

vec2 face_pixel(int face, vec3 d) {         // pixel coordinates on a face, row 0 at the top
    vec3 local = d * FACES[face];
    return (local.xy / local.z + 1.0) * (0.5 * float(face_size));
}

ivec2 face_origin(int face) { return ivec2(face % 3, face / 3) * face_size; }

vec4 fetch_inside(sampler2D atlas, int face, ivec2 pixel) {
    ivec2 inside = clamp(pixel, ivec2(0), ivec2(face_size - 1));
    return texelFetch(atlas, face_origin(face) + ivec2(inside.x, face_size - 1 - inside.y), 0);
}

// The neighbour face's pixel that touches this face's border: exchange `axis` and forward.
vec4 fetch_across(sampler2D atlas, int face, ivec2 pixel, int axis) {
    vec2 center = (2.0 * vec2(clamp(pixel, ivec2(0), ivec2(face_size - 1))) + 1.0) / float(face_size) - 1.0;
    vec3 local = vec3(center, 1.0);
    local.z = abs(center[axis]);
    local[axis] = pixel[axis] < 0 ? -1.0 : 1.0;
    vec3 d = FACES[face] * local;
    vec3 outward = FACES[face] * vec3(axis == 0 ? local.x : 0.0, axis == 1 ? local.y : 0.0, 0.0);
    int neighbour = face_of(outward);
    return fetch_inside(atlas, neighbour, ivec2(floor(face_pixel(neighbour, d))));
}

vec4 fetch(sampler2D atlas, int face, ivec2 pixel) {
    bvec2 outside = bvec2(pixel.x < 0 || pixel.x >= face_size, pixel.y < 0 || pixel.y >= face_size);
    if (!any(outside)) return fetch_inside(atlas, face, pixel);
    if (!all(outside)) return fetch_across(atlas, face, pixel, outside.x ? 0 : 1);
    // Three faces meet at a corner, so the fourth pixel does not exist.
    return (fetch_inside(atlas, face, pixel) + fetch_across(atlas, face, pixel, 0) +
            fetch_across(atlas, face, pixel, 1)) / 3.0;
}

vec4 sample_faces(sampler2D atlas, vec3 d) {
    int face = face_of(d);
    vec2 pixel = face_pixel(face, d);
    vec2 corner = floor(pixel - 0.5), f = pixel - 0.5 - corner;
    ivec2 p = ivec2(corner);
    vec4 top = mix(fetch(atlas, face, p), fetch(atlas, face, p + ivec2(1, 0)), f.x);
    vec4 bottom = mix(fetch(atlas, face, p + ivec2(0, 1)), fetch(atlas, face, p + ivec2(1, 1)), f.x);
    return mix(top, bottom, f.y);
}

vec2 atlas_uv(vec3 d) {
    int face = face_of(d);
    float side = float(face_size + 2);
    vec2 pixel = face_pixel(face, d) + 1.0;
    return (vec2(face % 3, face / 3) + vec2(pixel.x, side - pixel.y) / side) / vec2(3.0, 2.0);
}
