// A pose is a block on CUDA and a task on the CPU, whose loop the kernel closes.
#if defined(__CUDA_ARCH__)
const long long pose = block_index;
#else
share(state, n_poses, [&](long long pose) {
#endif
const T* angle = angles + pose * 3 * (n_joints - 1);
