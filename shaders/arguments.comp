// The arguments of indirect dispatches and draws of `total` splats, in chunks of `capacity`.
layout(local_size_x = 1) in;

uniform int num_chunks;
uniform int capacity;

layout(std430, binding = 0) readonly buffer Total { uint total; };
layout(std430, binding = 1) writeonly buffer Dispatches { uint dispatches[]; };  // three numbers a chunk
layout(std430, binding = 2) writeonly buffer Draws { uint draws[]; };            // five numbers a chunk
layout(std430, binding = 3) buffer Drawn { uint drawn; };                        // splats of this frame

void main() {
    for (int chunk = 0; chunk < num_chunks; chunk++) {
        int instances = clamp(int(total) - chunk * capacity, 0, capacity);
        dispatches[3 * chunk] = uint(instances + 63) / 64u;
        dispatches[3 * chunk + 1] = 1u;
        dispatches[3 * chunk + 2] = 1u;
        draws[5 * chunk] = 4u;
        draws[5 * chunk + 1] = uint(instances);
        draws[5 * chunk + 2] = 0u;
        draws[5 * chunk + 3] = 0u;
        draws[5 * chunk + 4] = 0u;
    }
    drawn += total;
}
