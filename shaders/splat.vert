// The four corners of a splat's quad, from its record (per-instance attributes).
in vec4 quad_1;
in vec4 quad_2;
in vec4 row_a;
in vec4 row_b;
in vec4 row_l;
in vec4 color;

uniform vec2 half_size;     // half the image, image-plane units
uniform vec4 cells[6];      // scale and offset of each part of a layer in the viewport, -1 to 1
uniform vec2 principals[6]; // window coordinates of the centre of each part

out float gl_ClipDistance[4];
flat out vec2 v_principal;

flat out vec2 v_base;
flat out vec4 v_a;
flat out vec4 v_b;
flat out vec4 v_l;
flat out vec3 v_color;

void main() {
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
    vec2 position = (quad_1.xy + corner.x * quad_1.zw + corner.y * quad_2.xy) / half_size;
    // The quad of a record that is not visible is one point outside the image.
    int part = int(color.w);
    vec2 placed = vec2(position.x, -position.y) * cells[part].xy + cells[part].zw;
    gl_Position = row_l.w > 0.0 ? vec4(placed, 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
    gl_ClipDistance[0] = 1.0 - position.x;
    gl_ClipDistance[1] = 1.0 + position.x;
    gl_ClipDistance[2] = 1.0 - position.y;
    gl_ClipDistance[3] = 1.0 + position.y;
    v_principal = principals[part];
    v_base = quad_2.zw;
    v_a = row_a;
    v_b = row_b;
    v_l = row_l;
    v_color = color.rgb;
}
