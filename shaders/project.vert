// Projects one Gaussian per vertex; transform feedback captures the record.
#include "splat.glsl"

in vec4 in_mean_opacity;
in vec4 in_quat;
in vec4 in_scale;
in vec4 in_color;

out vec4 quad_1;        // center, half_axis_1
out vec4 quad_2;        // half_axis_2, base
out vec4 row_a;         // a, thickness
out vec4 row_b;         // b, distance
out vec4 row_l;         // l, peak (0: not visible)
out vec4 color;         // RGB, 0

void main() {
    Gaussian gaussian = Gaussian(in_mean_opacity.xyz, in_mean_opacity.w, in_quat, in_scale.xyz);
    Footprint f;
    bool visible = project_gaussian(gaussian, f);
    quad_1 = visible ? vec4(f.center, f.half_axis_1) : vec4(0.0);
    quad_2 = visible ? vec4(f.half_axis_2, f.base) : vec4(0.0);
    row_a = visible ? vec4(f.a, f.thickness) : vec4(0.0);
    row_b = visible ? vec4(f.b, f.distance) : vec4(0.0);
    row_l = visible ? vec4(f.l, f.peak) : vec4(0.0);
    color = vec4(in_color.rgb, 0.0);
}
