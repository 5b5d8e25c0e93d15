// The four corners of a splat's quad, from its record (per-instance attributes).
in vec4 quad_1;
in vec4 quad_2;
in vec4 row_a;
in vec4 row_b;
in vec4 row_l;
in vec4 color;

uniform vec2 half_size;     // half the image, image-plane units

flat out vec2 v_base;
flat out vec4 v_a;
flat out vec4 v_b;
flat out vec4 v_l;
flat out vec3 v_color;

void main() {
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
    vec2 position = (quad_1.xy + corner.x * quad_1.zw + corner.y * quad_2.xy) / half_size;
    // The quad of a record that is not visible is one point outside the image.
    gl_Position = row_l.w > 0.0 ? vec4(position.x, -position.y, 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
    v_base = quad_2.zw;
    v_a = row_a;
    v_b = row_b;
    v_l = row_l;
    v_color = color.rgb;
}
