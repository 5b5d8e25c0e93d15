// Radix sort, step 1 of 3: how often each digit occurs in each tile of TILE_SIZE keys.
layout(local_size_x = DIGITS) in;

uniform int count;          // of the keys
uniform int shift;          // of the digit, bits
uniform int num_tiles;

layout(std430, binding = 0) readonly buffer Keys { uint keys[]; };
layout(std430, binding = 1) writeonly buffer Counts { uint counts[]; };    // digit by digit, tile by tile

shared uint occurrences[DIGITS];

void main() {
    uint thread = gl_LocalInvocationID.x, tile = gl_WorkGroupID.x;
    occurrences[thread] = 0u;
    barrier();
    for (uint i = tile * TILE_SIZE + thread; i < min((tile + 1u) * TILE_SIZE, uint(count)); i += DIGITS)
        atomicAdd(occurrences[(keys[i] >> shift) & (DIGITS - 1u)], 1u);
    barrier();
    counts[thread * uint(num_tiles) + tile] = occurrences[thread];
}
