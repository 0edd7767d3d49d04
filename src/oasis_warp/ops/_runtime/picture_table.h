// Kernels that `picture_extension.py` has described, for `picture_node.cpp`: all that Python knows of a kind of call.
#pragma once

#include <array>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <c10/util/SmallVector.h>

constexpr size_t N_SCENE = 9;  // tensors of `picture_call.Scene`

// What differs between calls of a kind: addresses and two sizes, under the names of the kernels' parameters. First the
// tensors of `picture_call.Scene`. `kept` is the workspace, or 0 for a picture without gradients.
#define SLOTS                                                                                                         \
    means, quats, scales, covars, opacities, colors, viewmats, Ks, backgrounds, workspace, kept, bad, capacity,       \
        longest_sorted, keys, spare, tile_gaussians, image, alphas, g_image, g_alpha, pair_records, tile_backgrounds, \
        g_means2d, g_covars2d, g_opacities, g_colors, g_means, g_quats, g_scales, g_covars
#define TEXT_OF(...) #__VA_ARGS__
#define TEXT(...) TEXT_OF(__VA_ARGS__)

struct Slots {
    int64_t SLOTS;
};

using LaunchKernel = size_t (*)(void*, void*, size_t, int, int, int, int, int, void**, void*, const void*);
using ErrorString = const char* (*)();

// A kernel, and its parameters: a value, or with a slot the slot's value and so much more; nothing added to 0.
struct Launch {
    std::string name;
    int64_t context, kernel;
    std::string bounds;  // Warp's launch bounds, copied
    size_t size;
    std::array<int, 5> numbers;  // largest number of blocks, threads of a block, stride, cluster, shared memory
    std::vector<std::pair<int, int64_t>> words;
};

struct Backward {
    int64_t record;                // numbers per pair
    std::vector<Launch> launches;  // blend_backward, gather
};

// The plan of a kind of call by one thread.
struct Table {
    int64_t launcher = 0, error = 0;  // addresses of functions
    std::array<Launch, 6> forward;    // project, count, place, fill, sort, blend
    std::optional<Launch> unproject;
    int64_t report = 0;  // three words that kernels write: pairs, longest list, bad values
    int64_t n = 0, n_cameras = 0, width = 0, height = 0, channels = 0, n_tiles = 0;
    int64_t size = 0, size_with_kept = 0;             // of the workspace [bytes]
    int64_t longest_in_tile = 0, longest_in_run = 0;  // lists up to which blending sorts, and a sort needs no spare
    std::array<int64_t, N_SCENE> numels{};            // -1: not given

    void run(const Launch& launch, const Slots& slots, int64_t stream) const {
        c10::SmallVector<int64_t, 64> filled;
        const auto* values = reinterpret_cast<const int64_t*>(&slots);
        for (const auto& [slot, value] : launch.words)
            filled.push_back(slot < 0 ? value : values[slot] ? values[slot] + value : 0);
        void* arguments[] = {const_cast<char*>(launch.bounds.data()), filled.data()};
        const auto& [blocks, threads, stride, cluster, memory] = launch.numbers;
        if (reinterpret_cast<LaunchKernel>(launcher)(
                reinterpret_cast<void*>(launch.context), reinterpret_cast<void*>(launch.kernel), launch.size, blocks,
                threads, stride, cluster, memory, arguments, reinterpret_cast<void*>(stream), nullptr
            ))
            throw std::runtime_error(launch.name + ": " + reinterpret_cast<ErrorString>(error)());
    }

    std::shared_ptr<const Backward> backward(bool shape, bool colors) {
        const std::lock_guard<std::mutex> lock(mutex_);
        const auto found = backwards_.find({shape, colors});
        return found == backwards_.end() ? nullptr : found->second;
    }

    void set_backward(bool shape, bool colors, int64_t record, std::vector<Launch> launches) {
        const std::lock_guard<std::mutex> lock(mutex_);
        backwards_[{shape, colors}] = std::make_shared<const Backward>(Backward{record, std::move(launches)});
    }

private:
    std::mutex mutex_;  // autograd's threads read what others write
    std::map<std::pair<bool, bool>, std::shared_ptr<const Backward>> backwards_;  // by which gradients are wanted
};
