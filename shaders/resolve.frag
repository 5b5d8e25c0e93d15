// The image from the sum of layers: docs/rendering.md, sections 4 and 7.
uniform sampler2D sum_color;    // outputs of accumulate.frag, blended
uniform sampler2D sum_depth;
uniform vec3 background;
uniform ivec2 origin;           // window coordinates of the image's corner
#ifdef INSPECT
uniform int scalar;             // number whose colour is shown: 0 none, 1 depth, 2 coverage
uniform float scalar_max;       // with the last colour; the first is 0
uniform sampler2D color_map;
#endif

layout(location = 0) out vec4 out_color;    // RGB over the background, coverage
layout(location = 1) out vec4 out_depth;    // radial distance, metres

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy) - origin;
    vec4 color = texelFetch(sum_color, pixel, 0);
    vec2 weighted = texelFetch(sum_depth, pixel, 0).rg;
    float depth = 0.0;
    out_color = vec4(background, 0.0);
    if (weighted.g > 0.0) {
        out_color = vec4(color.rgb * (color.a / weighted.g) + (1.0 - color.a) * background, color.a);
        depth = weighted.r / weighted.g;
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
