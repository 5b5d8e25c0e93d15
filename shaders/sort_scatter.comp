// Radix sort, step 3 of 3: moves each key and its value to its place. It is stable: a thread takes consecutive keys, and
// its places of each digit follow those of the threads before it.
layout(local_size_x = DIGITS) in;

uniform int count;
uniform int shift;
uniform int num_tiles;

layout(std430, binding = 0) readonly buffer Keys { uint keys[]; };
layout(std430, binding = 1) readonly buffer Values { uint values[]; };
layout(std430, binding = 2) readonly buffer Offsets { uint offsets[]; };   // the scanned counts of step 1
layout(std430, binding = 3) writeonly buffer SortedKeys { uint sorted_keys[]; };
layout(std430, binding = 4) writeonly buffer SortedValues { uint sorted_values[]; };

shared uint places[DIGITS * DIGITS];    // digit by digit, thread by thread

const uint KEYS_PER_THREAD = uint(TILE_SIZE) / DIGITS;

void main() {
    uint thread = gl_LocalInvocationID.x, tile = gl_WorkGroupID.x;
    uint first = tile * TILE_SIZE + thread * KEYS_PER_THREAD, end = min(first + KEYS_PER_THREAD, uint(count));
    for (uint digit = 0u; digit < DIGITS; digit++) places[digit * DIGITS + thread] = 0u;
    for (uint i = first; i < end; i++) places[((keys[i] >> shift) & (DIGITS - 1u)) * DIGITS + thread]++;
    barrier();
    uint running = offsets[thread * uint(num_tiles) + tile];    // this thread scans one digit
    for (uint other = 0u; other < DIGITS; other++) {
        uint number = places[thread * DIGITS + other];
        places[thread * DIGITS + other] = running;
        running += number;
    }
    barrier();
    for (uint i = first; i < end; i++) {
        uint key = keys[i];
        uint place = places[((key >> shift) & (DIGITS - 1u)) * DIGITS + thread]++;
        sorted_keys[place] = key;
        sorted_values[place] = values[i];
    }
}
