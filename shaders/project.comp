// GL 4.3 tier: projects one Gaussian per invocation and writes the same record as project.vert, farthest first.
layout(local_size_x = 64) in;

#include "splat.glsl"

uniform int first;              // splats that are farther than those of this chunk
uniform int capacity;           // of the chunk

struct StoredGaussian { vec4 mean_opacity, quat, scale; };
struct Record { vec4 quad_1, quad_2, row_a, row_b, row_l, color; };

layout(std430, binding = 0) readonly buffer Gaussians { StoredGaussian gaussians[]; };
layout(std430, binding = 1) readonly buffer Colors { vec4 colors[]; };
layout(std430, binding = 2) readonly buffer Visible { uint visible[]; };        // indices, front to back
layout(std430, binding = 3) writeonly buffer Records { Record records[]; };
layout(std430, binding = 4) readonly buffer Total { uint total; };              // of `visible`

void main() {
    uint slot = gl_GlobalInvocationID.x;
    if (slot >= uint(capacity) || uint(first) + slot >= total) return;
    uint entry = visible[total - 1u - uint(first) - slot], index = entry & 0x1FFFFFFFu;
    part = int(entry >> 29);
    StoredGaussian stored = gaussians[index];
    vec4 mean = stored.mean_opacity, scale = stored.scale;
    Gaussian gaussian = Gaussian(mean.xyz, mean.w, stored.quat, scale.xyz, int(scale.w));
    Footprint f;
    Record record = Record(vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0));
    if (project_gaussian(gaussian, f)) {
        record = Record(vec4(f.center, f.half_axis_1), vec4(f.half_axis_2, f.base), vec4(f.a, f.thickness),
                        vec4(f.b, f.distance), vec4(f.l, f.peak), vec4(colors[index].rgb, float(part)));
    }
    records[slot] = record;
}
