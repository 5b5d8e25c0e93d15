// One layer (the premultiplied picture of one set of Gaussians) at one pixel, weighted, to be added up.
// The layer is either a picture of the same size or the six faces of faces.glsl.
#include "faces.glsl"

uniform sampler2D layer_color;
uniform sampler2D layer_depth;
uniform int source;             // 0 picture, 1 faces seen by a pinhole, 2 faces seen by a panorama
uniform bool with_depth;
uniform float weight;
uniform vec2 size;              // of the output, pixels
uniform float focal;            // pixels, source 1
uniform mat3 camera_to_faces;

layout(location = 0) out vec4 out_color;
layout(location = 1) out vec4 out_depth;    // weighted alpha x distance, weight of layers with anything here

vec3 direction() {
    vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
    if (source == 1) return camera_to_faces * vec3((pixel - 0.5 * size) / focal, 1.0);
    const float PI = 3.14159265358979;
    float longitude = (2.0 * pixel.x / size.x - 1.0) * PI;
    float latitude = (pixel.y / size.y - 0.5) * PI;
    return camera_to_faces * vec3(cos(latitude) * sin(longitude), sin(latitude), cos(latitude) * cos(longitude));
}

void main() {
    vec4 value;
    float depth = 0.0;
    if (source == 0) {
        ivec2 pixel = ivec2(gl_FragCoord.xy);
        value = texelFetch(layer_color, pixel, 0);
        if (with_depth) depth = texelFetch(layer_depth, pixel, 0).r;
    } else {
        vec3 ray = direction();
        value = sample_faces(layer_color, ray);
        if (with_depth) depth = sample_faces(layer_depth, ray).r;
    }
    out_color = weight * value;
    out_depth = vec4(weight * depth, value.a > 0.0 ? weight : 0.0, 0.0, 0.0);
}
