// The colour of a mark in a headset.
uniform int shape;          // 0 plain, 1 ring, 2 plain outside of a circle, 3 picture
uniform vec4 color;         // premultiplied
uniform float radius;       // of the circle, in half sides
uniform sampler2D picture;  // premultiplied, top row first

in vec2 uv;

out vec4 out_color;

void main() {
    float r = length(uv);
    out_color = color;
    if (shape == 1) out_color *= (1.0 - smoothstep(0.97, 1.0, r)) * mix(0.25, 1.0, smoothstep(0.76, 0.8, r));
    if (shape == 2) out_color *= smoothstep(radius, 1.5 * radius, r);
    if (shape == 3) out_color *= texture(picture, 0.5 * uv + 0.5);
}
