// Do the tasks 0 .. n - 1 of a phase together with whoever else has this block. A thread waits only for tasks that
// another one has begun: it never matters whether, or when, a thread arrives. `share` returns when none is left to
// begin, and is for the last phase of a kernel; `phase` when all are done.
auto share = [&](long long* state, long long n, auto&& task) {
    long long t;
    while ((t = __atomic_fetch_add(state, 1, __ATOMIC_RELAXED)) < n) {
        task(t);
        __atomic_fetch_add(state + 8, 1, __ATOMIC_RELEASE);
    }
};
auto phase = [&](long long* state, long long n, auto&& task) {
    share(state, n, task);
    for (int spins = 0; __atomic_load_n(state + 8, __ATOMIC_ACQUIRE) < n; spins++) {
#if defined(__x86_64__)
        __builtin_ia32_pause();
#endif
        if (spins > 1000 && yield_thread) ((void (*)())yield_thread)();  // the other one may wait for this core
    }
};
