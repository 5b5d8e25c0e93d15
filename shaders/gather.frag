// One layer (the premultiplied picture of one set of Gaussians) at one pixel, weighted, to be added up.
// SOURCE says how the layer is kept: 0 a picture of the same size, 1 faces seen by a pinhole, 2 faces seen by a
// panorama. It is fixed at compile time because software GL pays for both sides of a branch.
#if SOURCE != 0
#include "faces.glsl"
#endif

uniform sampler2D layer_color;
uniform sampler2D layer_depth;
uniform bool with_depth;
uniform float weight;
uniform vec2 size;              // of the output, pixels
uniform float focal;            // pixels, source 1
uniform mat3 camera_to_faces;

layout(location = 0) out vec4 out_color;    // share x (premultiplied colour, alpha), share = weight x alpha
layout(location = 1) out vec4 out_depth;    // share x distance, share

void main() {
#if SOURCE == 0
    ivec2 place = ivec2(gl_FragCoord.xy);
    vec4 value = texelFetch(layer_color, place, 0);
    float depth = with_depth ? texelFetch(layer_depth, place, 0).r : 0.0;
#else
    vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
#if SOURCE == 1
    vec2 place = place_in_atlas(camera_to_faces * vec3((pixel - 0.5 * size) / focal, 1.0));
    vec4 value = textureLod(layer_color, place, 0.0);
    float depth = with_depth ? textureLod(layer_depth, place, 0.0).r : 0.0;
#else
    const float PI = 3.14159265358979;
    float longitude = (2.0 * pixel.x / size.x - 1.0) * PI;
    float latitude = (pixel.y / size.y - 0.5) * PI;
    vec3 ray = vec3(cos(latitude) * sin(longitude), sin(latitude), cos(latitude) * cos(longitude));
    vec4 value = sample_faces(layer_color, camera_to_faces * ray);
    float depth = with_depth ? sample_faces(layer_depth, camera_to_faces * ray).r : 0.0;
#endif
#endif
    float share = weight * value.a;
    out_color = share * value;
    out_depth = vec4(weight * depth, share, 0.0, 0.0);
}
