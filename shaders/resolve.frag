// The image from the sum of layers: docs/rendering.md, sections 4 and 7.
uniform sampler2D first_color;
uniform sampler2D first_depth;
uniform sampler2D second_color;
uniform sampler2D second_depth;
uniform bool difference;        // of two images, each over the background
uniform vec3 background;

layout(location = 0) out vec4 out_color;    // RGB over the background, coverage
layout(location = 1) out vec4 out_depth;    // radial distance, metres

// `color_sum` and `depth_sum` are the sums of accumulate.frag's outputs.
void normalize_sum(vec4 color_sum, vec4 depth_sum, out vec4 color, out float depth) {
    color = vec4(background, 0.0);
    depth = 0.0;
    if (depth_sum.g > 0.0) {
        float alpha = color_sum.a / depth_sum.g;
        color = vec4(color_sum.rgb / depth_sum.g + (1.0 - alpha) * background, alpha);
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
    out_depth = vec4(depth, 0.0, 0.0, 0.0);
}
