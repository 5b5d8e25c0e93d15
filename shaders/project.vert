// GL 3.3 tier: one vertex a visible Gaussian, captured by transform feedback as one record.
#include "splat.glsl"

in vec4 in_mean_opacity;
in vec4 in_quat;
in vec4 in_scale;
in vec4 in_color;

out vec4 quad_1;        // centre, axis 1
out vec4 quad_2;        // axis 2, base
out vec4 response_a;    // a, thickness
out vec4 response_b;    // b, radius
out vec4 response_l;    // l, opacity (0: not seen)
out vec4 color;         // rgb, 0

void main() {
    Gaussian gaussian = Gaussian(in_mean_opacity.xyz, in_mean_opacity.w, in_quat, in_scale.xyz);
    Footprint f;
    bool seen = project(gaussian, f);
    quad_1 = seen ? vec4(f.centre, f.axis_1) : vec4(0.0);
    quad_2 = seen ? vec4(f.axis_2, f.base) : vec4(0.0);
    response_a = seen ? vec4(f.a, f.thickness) : vec4(0.0);
    response_b = seen ? vec4(f.b, f.radius) : vec4(0.0);
    response_l = seen ? vec4(f.l, f.opacity) : vec4(0.0);
    color = vec4(in_color.rgb, 0.0);
}
