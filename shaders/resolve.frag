// The image from the sum of layers: docs/rendering.md, sections 4 and 7.
uniform sampler2D first_color;
uniform sampler2D first_depth;
uniform sampler2D second_color;
uniform sampler2D second_depth;
uniform bool difference;        // of two images, each over the background
uniform vec3 background;
#ifdef INSPECT
uniform int scalar;             // number whose colour is shown: 0 none, 1 depth, 2 coverage
uniform float scalar_max;       // with the last colour; the first is 0
uniform sampler2D color_map;
#endif

layout(location = 0) out vec4 out_color;    // RGB over the background, coverage
layout(location = 1) out vec4 out_depth;    // radial distance, metres

// `color_sum` and `depth_sum` are the blended outputs of accumulate.frag.
void normalize_sum(vec4 color_sum, vec4 depth_sum, out vec4 color, out float depth) {
    color = vec4(background, 0.0);
    depth = 0.0;
    if (depth_sum.g > 0.0) {
        float alpha = color_sum.a;
        color = vec4(color_sum.rgb * (alpha / depth_sum.g) + (1.0 - alpha) * background, alpha);
        depth = depth_sum.r / depth_sum.g;
    }
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    float depth;
    normalize_sum(texelFetch(first_color, pixel, 0), texelFetch(first_depth, pixel, 0), out_color, depth);
    if (difference) {
        vec4 other;
        float other_depth;
        normalize_sum(texelFetch(second_color, pixel, 0), texelFetch(second_depth, pixel, 0), other, other_depth);
        out_color = vec4(abs(out_color.rgb - other.rgb), max(out_color.a, other.a));
        depth = abs(depth - other_depth);
    }
#ifdef INSPECT
    if (scalar > 0) {
        float value = scalar == 1 ? depth : out_color.a;
        vec3 mapped = textureLod(color_map, vec2(value / scalar_max, 0.5), 0.0).rgb;
        out_color.rgb = out_color.a > 0.0 ? mapped : background;
    }
#endif
    out_depth = vec4(depth, 0.0, 0.0, 0.0);
}
