// One weighted layer at one pixel. Blending adds the layers up, and keeps the largest alpha.
// LAYER_STORAGE: 0 one image of the same size, 1 cube faces. A compile-time constant, because software OpenGL executes
// both sides of a branch.
#if LAYER_STORAGE != 0
#include "faces.glsl"
#endif

uniform sampler2D layer_color;
uniform sampler2D layer_depth;
uniform bool with_depth;
uniform float weight;
uniform vec2 size;              // of the output, pixels
uniform float focal;            // pixels
uniform mat3 camera_to_faces;

layout(location = 0) out vec4 out_color;    // weight x premultiplied colour, alpha
layout(location = 1) out vec4 out_depth;    // weight x (alpha x distance, alpha)

void main() {
#if LAYER_STORAGE == 0
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec4 value = texelFetch(layer_color, texel, 0);
    float depth = with_depth ? texelFetch(layer_depth, texel, 0).r : 0.0;
#else
    vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
    vec2 uv = atlas_uv(camera_to_faces * vec3((pixel - 0.5 * size) / focal, 1.0));
    vec4 value = textureLod(layer_color, uv, 0.0);
    float depth = with_depth ? textureLod(layer_depth, uv, 0.0).r : 0.0;
#endif
    out_color = vec4(weight * value.rgb, value.a);
    out_depth = vec4(weight * vec2(depth, value.a), 0.0, 0.0);
}
