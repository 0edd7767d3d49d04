// Whether numbers on a CUDA device are finite and of a sensible size: one launch for several arrays.
//
// A block looks at `CHUNK` numbers of one array; what is wrong is one word in memory of the host, for whoever waits for
// the device to read.

__global__ void all_finite(
    volatile long long* found,
    double largest,
    const void* data0,
    long long count0,
    int wide0,
    const void* data1,
    long long count1,
    int wide1,
    const void* data2,
    long long count2,
    int wide2,
    const void* data3,
    long long count3,
    int wide3,
    const void* data4,
    long long count4,
    int wide4,
    const void* data5,
    long long count5,
    int wide5,
    const void* data6,
    long long count6,
    int wide6,
    const void* data7,
    long long count7,
    int wide7,
    const void* data8,
    long long count8,
    int wide8,
    const void* data9,
    long long count9,
    int wide9
) {
    const void* data = nullptr;
    long long count = 0, first = 0, chunk = block_index;
    int wide = 0;
#define SELECT(k)                                                \
    if (chunk >= 0) {                                            \
        const long long chunks = (count##k + CHUNK - 1) / CHUNK; \
        if (chunk < chunks) {                                    \
            data = data##k;                                      \
            count = count##k;                                    \
            wide = wide##k;                                      \
            first = chunk * CHUNK;                               \
        }                                                        \
        chunk -= chunks;                                         \
    }
    SELECT(0)
    SELECT(1)
    SELECT(2)
    SELECT(3)
    SELECT(4)
    SELECT(5)
    SELECT(6)
    SELECT(7)
    SELECT(8)
    SELECT(9)
#undef SELECT
    const long long end = first + CHUNK < count ? first + CHUNK : count;
    bool bad = false;
    if (wide) {
        const double* const values = (const double*)data;
        for (long long i = first + threadIdx.x; i < end; i += BLOCK)
            bad |= !(values[i] >= -largest && values[i] <= largest);  // true for NaN too
    } else {
        const float* const values = (const float*)data;
        for (long long i = first + threadIdx.x; i < end; i += BLOCK)
            bad |= !(values[i] >= -(float)largest && values[i] <= (float)largest);
    }
    if (bad) *found = 1;
}
