// The picture from the added layers: docs/rendering.md, sections 4 and 7.
uniform sampler2D first_color;
uniform sampler2D first_depth;
uniform sampler2D second_color;
uniform sampler2D second_depth;
uniform bool difference;        // of two pictures, each over the background
uniform vec3 background;

layout(location = 0) out vec4 out_color;    // rgb over the background, alpha the coverage
layout(location = 1) out vec4 out_depth;

// `sum` and `extra` are what gather.frag added up.
void picture(vec4 sum, vec4 extra, out vec4 color, out float depth) {
    color = vec4(background, 0.0);
    depth = 0.0;
    if (extra.g > 0.0) {
        float alpha = sum.a / extra.g;
        color = vec4(sum.rgb / extra.g + (1.0 - alpha) * background, alpha);
        depth = extra.r / extra.g;
    }
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    float depth;
    picture(texelFetch(first_color, pixel, 0), texelFetch(first_depth, pixel, 0), out_color, depth);
    if (difference) {
        vec4 other;
        float other_depth;
        picture(texelFetch(second_color, pixel, 0), texelFetch(second_depth, pixel, 0), other, other_depth);
        out_color = vec4(abs(out_color.rgb - other.rgb), max(out_color.a, other.a));
        depth = abs(depth - other_depth);
    }
    out_depth = vec4(depth, 0.0, 0.0, 0.0);
}
