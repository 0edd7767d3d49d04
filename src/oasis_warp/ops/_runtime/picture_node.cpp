// One node of autograd for float32 pictures on CUDA, without the interpreter.
//
// `picture_plan.py` plans each kind of call: which kernels run, on how many blocks, and what each parameter is. Here
// addresses are filled in and kernels launched by Warp's own entry, so no header of CUDA is needed. What is rare goes
// back to Python, which then draws or differentiates the same bits: lists that do not fit, bad values, gradients of
// gradients, of cameras and of meta["means2d"].
#include "picture_table.h"

#include <atomic>
#include <chrono>

#include <ATen/ATen.h>
#include <c10/core/SafePyObject.h>
#include <c10/core/impl/VirtualGuardImpl.h>
#include <torch/csrc/Exceptions.h>
#include <torch/csrc/PyInterpreter.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/csrc/utils/pybind.h>

using at::Tensor;
using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

constexpr size_t MEANS = 0, OPACITIES = 4, COLORS = 5, VIEWMATS = 6, BACKGROUNDS = 8;  // places in a scene
constexpr const char* SCENE_NAMES[N_SCENE] = {"means",  "quats",    "scales", "covars",     "opacities",
                                              "colors", "viewmats", "Ks",     "backgrounds"};
using Scene = std::array<Tensor, N_SCENE>;
using Given = std::array<std::optional<Tensor>, N_SCENE>;
using Wanted = std::array<bool, N_SCENE>;

// Looks at words that the device is about to write before the thread sleeps, as long as those of `pair_counts.py`.
constexpr auto SPIN = std::chrono::microseconds(100);

// What the adjoint of one picture needs besides tensors. Python sees it as the picture's `tracking`.
struct Call : torch::CustomClassHolder {
    Call(std::shared_ptr<Table> table, py::object plan, int64_t stream)
        : table(std::move(table)), plan(plan.release().ptr(), getPyInterpreter()), stream(stream) {}

    void look(py::object means2d) {
        means2d_.emplace(means2d.release().ptr(), getPyInterpreter());
        looked = true;
    }

    // A weak reference to meta["means2d"]; with the interpreter's lock.
    py::object means2d() const {
        return means2d_ ? py::reinterpret_borrow<py::object>(means2d_->ptr(getPyInterpreter())) : py::none();
    }

    std::shared_ptr<Table> table;
    c10::SafePyObject plan;
    int64_t stream, pairs = 0;
    std::atomic<bool> looked{false};

private:
    std::optional<c10::SafePyObject> means2d_;
};

struct Drawn {
    bool bad = false;
    int64_t pairs = 0, longest = 0;
    Tensor image, alphas, workspace, lists;  // no image: there was no memory for as many pairs
};

static int64_t address(const Tensor& tensor) {
    return tensor.defined() ? reinterpret_cast<int64_t>(tensor.data_ptr()) : 0;
}

static Slots slots_of(const Scene& scene) {
    Slots slots{};
    for (size_t k = 0; k < N_SCENE; k++) reinterpret_cast<int64_t*>(&slots)[k] = address(scene[k]);
    return slots;
}

static Scene checked(const Table& table, const Given& given) {
    Scene scene;
    for (size_t k = 0; k < N_SCENE; k++) {
        const int64_t numel = given[k] ? given[k]->numel() : -1;
        if (numel != table.numels[k] || (given[k] && given[k]->scalar_type() != at::kFloat))
            throw std::invalid_argument(
                std::string(SCENE_NAMES[k]) + ": expected " + std::to_string(table.numels[k]) +
                " float32 numbers, as planned, got " + std::to_string(numel) + ". Plan calls of this kind anew."
            );
        if (given[k]) scene[k] = given[k]->contiguous();
    }
    return scene;
}

static void synchronize(c10::Device device) {
    const c10::impl::VirtualGuardImpl guard(device.type());
    guard.synchronizeStream(guard.getStream(device));
}

// Waits until kernels have written the first two words, or until the current stream is done.
static void wait(const volatile int64_t* report, c10::Device device) {
    const auto end = std::chrono::steady_clock::now() + SPIN;
    while (report[0] < 0 || report[1] < 0)
        if (std::chrono::steady_clock::now() > end) return synchronize(device);
}

static Drawn launch_picture(
    const Table& table, int64_t stream, int64_t capacity, int64_t longest, bool validate, bool keep, const Scene& scene
) {
    const auto options = scene[MEANS].options();
    auto* report = reinterpret_cast<volatile int64_t*>(table.report);
    Drawn drawn;
    drawn.workspace = at::empty({keep ? table.size_with_kept : table.size}, options.dtype(at::kByte));
    Slots slots = slots_of(scene);
    slots.workspace = address(drawn.workspace);
    slots.kept = keep ? slots.workspace : 0;
    slots.bad = validate ? table.report + 16 : 0;
    slots.capacity = capacity;
    slots.longest_sorted = longest;
    const bool sorts = longest > table.longest_in_tile;
    const auto& [project, count, place, fill, sort, blend] = table.forward;
    report[0] = report[1] = -1;
    report[2] = 0;
    table.run(project, slots, stream);
    drawn.image = at::empty({table.n_cameras, table.height, table.width, table.channels}, options);
    drawn.alphas = at::empty({table.n_cameras, table.height, table.width, 1}, options);
    // One more than there may be, as an empty tensor has no address.
    const Tensor keys = at::empty({capacity + 1}, options.dtype(at::kLong));
    if (keep || sorts) drawn.lists = at::empty({capacity + 1}, options.dtype(at::kInt));
    slots.image = address(drawn.image);
    slots.alphas = address(drawn.alphas);
    slots.keys = address(keys);
    slots.tile_gaussians = address(drawn.lists);
    for (const Launch* launch : {&count, &place, &fill}) table.run(*launch, slots, stream);
    Tensor spare;
    if (sorts) {
        if (longest > table.longest_in_run) spare = at::empty_like(keys);
        slots.spare = address(spare);
        table.run(sort, slots, stream);
    }
    table.run(blend, slots, stream);
    wait(report, scene[MEANS].device());
    std::atomic_thread_fence(std::memory_order_acquire);
    drawn.pairs = report[0];
    drawn.longest = report[1];
    drawn.bad = report[2] != 0;
    if (drawn.pairs > capacity || drawn.longest > longest) drawn.image = Tensor();
    return drawn;
}

// The gradients by the tensors of a scene, by the kernels of `Plan.draw_backward`.
static variable_list launch_backward(
    const Call& call,
    const Backward& kernels,
    bool with_shape,
    bool with_colors,
    const Wanted& wanted,
    const Scene& scene,
    const Tensor& workspace,
    const Tensor& lists,
    const Tensor& g_image,
    const Tensor& g_alphas
) {
    const Table& table = *call.table;
    const auto options = scene[MEANS].options();
    const int64_t n = table.n, n_cameras = table.n_cameras, total = n * n_cameras, channels = table.channels;
    const bool one = n_cameras == 1, shared = scene[COLORS].dim() == 2;
    Slots slots = slots_of(scene);
    slots.workspace = slots.kept = address(workspace);
    slots.tile_gaussians = address(lists);
    slots.g_image = address(g_image);
    slots.g_alpha = address(g_alphas);
    slots.capacity = call.pairs;
    // One tensor for all that is only passed on: by covars2d (float64) and means2d, then the records.
    const Tensor passed = at::empty({8 * total * with_shape + call.pairs * kernels.record + 4}, options);
    slots.g_covars2d = with_shape ? address(passed) : 0;
    slots.g_means2d = with_shape ? address(passed) + 24 * total : 0;
    slots.pair_records = address(passed) + 32 * total * with_shape;
    Tensor by_tile, g_opacities, g_colors;
    if (wanted[BACKGROUNDS]) by_tile = at::empty({n_cameras, table.n_tiles / n_cameras, channels}, options);
    slots.tile_backgrounds = address(by_tile);
    table.run(kernels.launches[0], slots, call.stream);
    if (with_shape) g_opacities = one ? at::empty({n}, options) : at::empty({n_cameras, n}, options);
    if (with_colors)
        g_colors = one && shared ? at::empty({n, channels}, options) : at::empty({n_cameras, n, channels}, options);
    slots.g_opacities = address(g_opacities);
    slots.g_colors = address(g_colors);
    if (with_shape || with_colors) table.run(kernels.launches[1], slots, call.stream);
    variable_list gradients(N_SCENE);
    bool unprojects = false;
    for (size_t k = 0; k < OPACITIES; k++) {
        if (!wanted[k] || !scene[k].defined()) continue;
        gradients[k] = at::empty(scene[k].sizes(), options);
        unprojects = true;
    }
    slots.g_means = address(gradients[0]);
    slots.g_quats = address(gradients[1]);
    slots.g_scales = address(gradients[2]);
    slots.g_covars = address(gradients[3]);
    if (unprojects) table.run(*table.unproject, slots, call.stream);
    if (wanted[OPACITIES]) gradients[OPACITIES] = one ? g_opacities : g_opacities.sum(0);
    if (with_colors) gradients[COLORS] = shared && !one ? g_colors.sum(0) : g_colors;
    if (by_tile.defined()) gradients[BACKGROUNDS] = by_tile.sum(1);
    return gradients;
}

// The same by `picture_node.differentiate`, which knows all cases, and has the kernels compiled that are new.
static variable_list differentiate_in_python(
    const Call& call, const Wanted& wanted, const variable_list& saved, const variable_list& incoming
) {
    const py::gil_scoped_acquire lock;
    try {
        const py::tuple scene(N_SCENE), needed(N_SCENE);
        for (size_t k = 0; k < N_SCENE; k++) {
            scene[k] = py::cast(saved[k]);
            needed[k] = py::bool_(wanted[k]);
        }
        const auto node = py::module_::import("oasis_warp.ops._runtime.picture_node");
        const py::sequence found = node.attr("differentiate_for_extension")(
            py::reinterpret_borrow<py::object>(call.plan.ptr(getPyInterpreter())), call.means2d(), needed, scene,
            py::make_tuple(saved[N_SCENE], saved[N_SCENE + 1], call.pairs), incoming[0], incoming[1]
        );
        variable_list gradients(N_SCENE);
        for (size_t k = 0; k < N_SCENE; k++)
            if (!found[k].is_none()) gradients[k] = found[k].cast<Tensor>();
        return gradients;
    } catch (py::error_already_set& error) {  // as autograd hands Python's errors from its threads to ours
        error.restore();
        python_error raised;
        raised.persist();
        throw raised;
    }
}

struct Picture : torch::autograd::Function<Picture> {
    template <typename... Tensors>
    static variable_list forward(
        AutogradContext* ctx, const c10::intrusive_ptr<Call>& call, const Drawn& drawn, const Tensors&... scene
    ) {
        ctx->save_for_backward({scene.value_or(Tensor())..., drawn.workspace, drawn.lists});
        ctx->saved_data["call"] = c10::IValue::make_capsule(call);
        ctx->set_materialize_grads(false);
        return {drawn.image, drawn.alphas};
    }

    static variable_list backward(AutogradContext* ctx, variable_list incoming) {
        variable_list results(2);  // the two arguments before the tensors
        const auto saved = ctx->get_saved_variables();
        const auto capsule = ctx->saved_data["call"].toCapsule();
        const Call& call = static_cast<const Call&>(*capsule);
        variable_list gradients(N_SCENE);
        if (incoming[0].defined() || incoming[1].defined()) gradients = differentiate(ctx, call, saved, incoming);
        for (auto& gradient : gradients) results.push_back(std::move(gradient));
        return results;
    }

private:
    static variable_list differentiate(
        AutogradContext* ctx, const Call& call, const variable_list& saved, const variable_list& incoming
    ) {
        Wanted wanted{};
        size_t edge = 0;  // tensors that are not given have none
        for (size_t k = 0; k < N_SCENE; k++) wanted[k] = saved[k].defined() && ctx->needs_input_grad(edge++);
        bool with_shape = false;
        for (size_t k = 0; k <= OPACITIES; k++) with_shape |= wanted[k];
        const bool with_colors = wanted[COLORS];
        const auto kernels = call.table->backward(with_shape, with_colors);
        if (!kernels || call.looked || wanted[VIEWMATS] || at::GradMode::is_enabled())
            return differentiate_in_python(call, wanted, saved, incoming);
        const at::AutoDispatchBelowADInplaceOrView guard;
        std::array<Tensor, 2> gradients;
        Scene scene;
        for (size_t k = 0; k < N_SCENE; k++)
            if (saved[k].defined()) scene[k] = saved[k].contiguous();
        for (size_t k = 0; k < 2; k++)
            if (incoming[k].defined()) gradients[k] = incoming[k].contiguous();
        return launch_backward(
            call, *kernels, with_shape, with_colors, wanted, scene, saved[N_SCENE], saved[N_SCENE + 1], gradients[0],
            gradients[1]
        );
    }
};

// Whether values are bad, pairs, the longest list, image, alphas, workspace, and what tracks gradients.
using Result = std::tuple<bool, int64_t, int64_t, std::optional<Tensor>, Tensor, Tensor, c10::intrusive_ptr<Call>>;

static Result draw(
    const std::shared_ptr<Table>& table,
    py::object plan,
    int64_t stream,
    int64_t capacity,
    int64_t longest,
    bool validate,
    bool tracked,
    const Given& given
) {
    auto call = tracked ? c10::make_intrusive<Call>(table, std::move(plan), stream) : c10::intrusive_ptr<Call>();
    const py::gil_scoped_release unlocked;
    Drawn drawn;
    {
        const at::AutoDispatchBelowADInplaceOrView guard;
        const Scene scene = checked(*table, given);
        try {
            drawn = launch_picture(*table, stream, capacity, longest, validate, tracked, scene);
        } catch (...) {  // kernels that are on their way still write to the words
            synchronize(scene[MEANS].device());
            throw;
        }
    }
    std::optional<Tensor> image;
    if (!drawn.bad && drawn.image.defined()) image = drawn.image;
    if (image && tracked) {
        call->pairs = drawn.pairs;
        const auto outputs =
            std::apply([&](const auto&... scene) { return Picture::apply(call, drawn, scene...); }, given);
        image = outputs[0];
        drawn.alphas = outputs[1];
    }
    return {drawn.bad, drawn.pairs, drawn.longest, image, drawn.alphas, drawn.workspace, std::move(call)};
}

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
    m.attr("SLOTS") = TEXT(SLOTS);
    py::class_<Launch>(m, "Launch")
        .def(
            py::init([](std::string name, int64_t context, int64_t kernel, py::bytes bounds, size_t size,
                        std::array<int, 5> numbers, std::vector<std::pair<int, int64_t>> words) {
                return Launch{std::move(name), context, kernel, bounds, size, numbers, std::move(words)};
            })
        );
    py::class_<Call, c10::intrusive_ptr<Call>>(m, "Call").def_property("means2d", &Call::means2d, &Call::look);
    py::class_<Table, std::shared_ptr<Table>>(m, "Table")
        .def(py::init<>())
        .def_readwrite("launcher", &Table::launcher)
        .def_readwrite("error", &Table::error)
        .def_readwrite("forward", &Table::forward)
        .def_readwrite("unproject", &Table::unproject)
        .def_readwrite("report", &Table::report)
        .def_readwrite("n", &Table::n)
        .def_readwrite("n_cameras", &Table::n_cameras)
        .def_readwrite("width", &Table::width)
        .def_readwrite("height", &Table::height)
        .def_readwrite("channels", &Table::channels)
        .def_readwrite("n_tiles", &Table::n_tiles)
        .def_readwrite("size", &Table::size)
        .def_readwrite("size_with_kept", &Table::size_with_kept)
        .def_readwrite("longest_in_tile", &Table::longest_in_tile)
        .def_readwrite("longest_in_run", &Table::longest_in_run)
        .def_readwrite("numels", &Table::numels)
        .def("set_backward", &Table::set_backward)
        .def("draw", torch::wrap_pybind_function(&draw));
}
