// Lists the selected splats that can touch each part of a layer, part by part, in their order. Step 1 (WRITE 0) counts them in each tile of
// TILE_SIZE splats, step 2 (WRITE 1) writes their indices from the scanned counts on. The bound of a splat is that of
// SortedSplats.cull: a ball of its reach, widened by the low-pass filter.
layout(local_size_x = 64) in;

uniform int count;
uniform vec3 position;          // camera centre, in the moved frame of the means
uniform vec4 planes[30];        // inward normal and offset of the sides of the view, five for each part
uniform int num_planes;
uniform float deviation;        // of the filter, radians, enlarged by rounding
uniform bool bounded;           // whether a splat ends at its ball; else only its centre is compared

struct StoredGaussian { vec4 mean_opacity, quat, scale; };

layout(std430, binding = 0) readonly buffer Gaussians { StoredGaussian gaussians[]; };
layout(std430, binding = 1) readonly buffer Selected { uint selected[]; };      // one bit a splat
layout(std430, binding = 2) readonly buffer Order { uint order[]; };            // indices, front to back
layout(std430, binding = 3) buffer Counts { uint counts[]; };                   // of each tile, part by part
layout(std430, binding = 4) writeonly buffer Visible { uint visible[]; };       // index, and part from bit 29 on

shared uint sums[64];

const uint SPLATS_PER_THREAD = uint(TILE_SIZE) / 64u;

bool is_visible(uint index, uint part) {
    if ((selected[index >> 5] >> (index & 31u) & 1u) == 0u) return false;
    StoredGaussian stored = gaussians[index];
    float reach = sqrt(2.0 * log(max(stored.mean_opacity.w / ALPHA_CUT, 1.0)));
    float bound = 0.0;
    if (bounded) {
        float largest = max(max(stored.scale.x, stored.scale.y), stored.scale.z);
        bound = length(stored.mean_opacity.xyz - position) * (deviation * reach + 1e-5) + 1.001 * reach * largest;
    }
    for (int i = 0; i < num_planes; i++)
        if (dot(planes[5u * part + uint(i)].xyz, stored.mean_opacity.xyz) + bound < planes[5u * part + uint(i)].w)
            return false;
    return true;
}

void main() {
    uint thread = gl_LocalInvocationID.x, tile = gl_WorkGroupID.x, part = gl_WorkGroupID.y;
    uint first = tile * TILE_SIZE + thread * SPLATS_PER_THREAD, end = min(first + SPLATS_PER_THREAD, uint(count));
    uint mask = 0u;
    for (uint i = first; i < end; i++) mask |= is_visible(order[i], part) ? 1u << (i - first) : 0u;
    sums[thread] = uint(bitCount(mask));
    barrier();
    uint place = 0u;
    for (uint other = 0u; other < 64u; other++) place += other < thread || WRITE == 0 ? sums[other] : 0u;
#if WRITE == 0
    if (thread == 0u) counts[part * gl_NumWorkGroups.x + tile] = place;
#else
    place += counts[part * gl_NumWorkGroups.x + tile];
    for (uint i = first; i < end; i++)
        if ((mask >> (i - first) & 1u) != 0u) visible[place++] = order[i] | part << 29;
#endif
}
