// Keys whose ascending order is the order of the splats, front to back: bits of the squared distance or of the depth.
layout(local_size_x = 64) in;

uniform int count;
uniform vec3 position;      // camera centre, in the moved frame of the means
uniform vec3 forward;       // of the camera, for the order by depth
uniform bool by_depth;

struct StoredGaussian { vec4 mean_opacity, quat, scale; };

layout(std430, binding = 0) readonly buffer Gaussians { StoredGaussian gaussians[]; };
layout(std430, binding = 1) writeonly buffer Keys { uint keys[]; };
layout(std430, binding = 2) writeonly buffer Values { uint values[]; };

void main() {
    uint index = gl_GlobalInvocationID.x + gl_GlobalInvocationID.y * gl_NumWorkGroups.x * gl_WorkGroupSize.x;
    if (index >= uint(count)) return;
    vec3 mean = gaussians[index].mean_opacity.xyz;
    // `precise`: equal on every GPU and equal to the processor's, also for ties.
    precise vec3 offset = mean - position;
    precise vec3 squares = offset * offset;
    precise float key = squares.x + squares.y;
    key = key + squares.z;
    if (by_depth) {
        key = dot(forward, offset);
        key += 0.0;         // -0 becomes 0
    }
    uint bits = floatBitsToUint(key);
    keys[index] = (bits >> 31) != 0u ? ~bits : bits | 0x80000000u;
    values[index] = index;
}
