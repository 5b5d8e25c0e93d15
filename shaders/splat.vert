// The four corners of one splat's quad, from its record (per-instance attributes).
in vec4 quad_1;
in vec4 quad_2;
in vec4 response_a;
in vec4 response_b;
in vec4 response_l;
in vec4 color;

uniform vec2 half_size;     // half the picture, image-plane units

flat out vec2 v_base;
flat out vec4 v_a;
flat out vec4 v_b;
flat out vec4 v_l;
flat out vec3 v_color;

void main() {
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
    vec2 place = (quad_1.xy + corner.x * quad_1.zw + corner.y * quad_2.xy) / half_size;
    // A record that is not seen becomes four equal points outside the picture.
    gl_Position = response_l.w > 0.0 ? vec4(place.x, -place.y, 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
    v_base = quad_2.zw;
    v_a = response_a;
    v_b = response_b;
    v_l = response_l;
    v_color = color.rgb;
}
