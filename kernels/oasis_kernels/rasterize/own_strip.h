// The strip of a task, and its list.
const long long s = order[task];
const Strip p = strip_of(s);
const long long start = starts[s];
const int count = (int)(starts[s + 1] - start);
