// `phase`, for n items in ranges: range(first, end).
auto ranges = [&](long long* progress, long long n, auto&& range) {
    phase(progress, (n + 1023) / TASK, [&](long long task) {
        range((int)(task * TASK), (int)wp::min(task * TASK + TASK, n));
    });
};
