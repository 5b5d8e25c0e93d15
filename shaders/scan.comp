// Exclusive prefix sums of `count` numbers in place, by one work group; `total` is the sum of all.
layout(local_size_x = 256) in;

uniform int count;

layout(std430, binding = 0) buffer Numbers { uint numbers[]; };
layout(std430, binding = 1) buffer Total { uint total; };

shared uint sums[256];

void main() {
    uint thread = gl_LocalInvocationID.x;
    uint length = (uint(count) + 255u) / 256u, first = thread * length, end = min(first + length, uint(count));
    uint sum = 0u;
    for (uint i = first; i < end; i++) sum += numbers[i];
    sums[thread] = sum;
    barrier();
    for (uint step = 1u; step < 256u; step *= 2u) {
        uint before = thread >= step ? sums[thread - step] : 0u;
        barrier();
        sums[thread] += before;
        barrier();
    }
    uint running = sums[thread] - sum;
    for (uint i = first; i < end; i++) {
        uint number = numbers[i];
        numbers[i] = running;
        running += number;
    }
    if (thread == 255u) total = sums[255];
}
