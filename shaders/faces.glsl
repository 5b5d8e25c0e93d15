// Look-up in six cube faces that are stored in one texture (an atlas of three columns and two rows). `atlas_uv` returns
// texture coordinates for the texture unit's filter; the faces have a border of one pixel.

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

vec2 atlas_uv(vec3 d) {
    int face = face_of(d);
    float side = float(face_size + 2);
    vec2 pixel = face_pixel(face, d) + 1.0;
    return (vec2(face % 3, face / 3) + vec2(pixel.x, side - pixel.y) / side) / vec2(3.0, 2.0);
}
