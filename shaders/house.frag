// The colour of the doll's house.
uniform sampler2D atlas;

in vec2 v_uv;

out vec4 out_color;

void main() {
    vec3 color = texture(atlas, v_uv).rgb;
    out_color = vec4(max(v_uv.x, v_uv.y) > 1.0 ? vec3(0.88, 0.87, 0.85) : color, 1.0);  // tops of walls are plain
}
