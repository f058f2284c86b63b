// The binding: checks shapes, lets the interpreter go, spreads blocks over threads. Compiled for the baseline only.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "kernel.hpp"

namespace nb = nanobind;

namespace {

using saltus::Kernel, saltus::Model;
using Array = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Index = nb::ndarray<const std::int64_t, nb::ndim<1>, nb::device::cpu>;  // any stride, no other type
using Out = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
using Size = std::ptrdiff_t;

constexpr int kMostStates = 256, kMostMeasured = 256, kMostModes = 1 << 16;

[[noreturn]] void fail(const char* error, const std::string& message) {
  PyErr_SetString(nb::module_::import_("saltus.errors").attr(error).ptr(), message.c_str());
  throw nb::python_error();
}

void require(bool condition, const std::string& message) {
  if (!condition) fail("ModelError", message);
}

std::string shape_of(const Array& a) {
  std::string text = "(";
  for (std::size_t i = 0; i < a.ndim(); ++i) text += (i ? ", " : "") + std::to_string(a.shape(i));
  return text + ")";
}

bool runs_here(const Kernel* kernel) {
  if (!kernel) return false;
#if defined(__x86_64__)
  __builtin_cpu_init();
  if (kernel == saltus::kAvx512)
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl") &&
           __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
           __builtin_cpu_supports("bmi2");
  if (kernel == saltus::kAvx2)
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
#endif
  return true;
}

// Names of the instruction sets this machine runs, the widest first.
std::vector<std::string> instruction_sets() {
  std::vector<std::string> names;
  for (const Kernel* kernel : {saltus::kAvx512, saltus::kAvx2, saltus::kBaseline})
    if (runs_here(kernel)) names.emplace_back(kernel->name);
  return names;
}

const Kernel& kernel_of(const std::string& name) {
  for (const Kernel* kernel : {saltus::kAvx512, saltus::kAvx2, saltus::kBaseline})
    if (runs_here(kernel) && (name.empty() || name == kernel->name)) return *kernel;
  fail("ModelError", "this machine has no instruction set '" + name + "'; see saltus info --system.");
}

struct Free {
  void operator()(double* p) const { std::free(p); }
};
using Workspace = std::unique_ptr<double, Free>;

Workspace allocate(std::size_t doubles) {
  const std::size_t bytes = (doubles * sizeof(double) + 63) / 64 * 64;
  double* p = static_cast<double*>(std::aligned_alloc(64, bytes ? bytes : 64));
  if (!p) throw std::bad_alloc();
  return Workspace(p);
}

// Chain sizes, and for each way an array may depend on chains the table from mode to its own row.
class Modes {
 public:
  explicit Modes(std::vector<int> sizes) : sizes_(std::move(sizes)) {
    for (int size : sizes_) {
      require(size >= 1 && size <= kMostModes, "a chain needs at least one state.");
      count_ *= size;
      require(count_ <= kMostModes, "the compiled kernel holds at most 65536 modes.");
    }
  }
  int count() const { return int(count_); }
  int chains() const { return int(sizes_.size()); }
  const int* sizes() const { return sizes_.data(); }

  // The table for an array whose mode axes are `axes` (each 1 or the chain's size), or an empty one.
  std::vector<int> table(const std::vector<Size>& axes) const {
    std::vector<int> which(count(), 0);
    for (int mode = 0; mode < count(); ++mode) {
      int rest = mode, stride = 1;
      for (int c = chains() - 1; c >= 0; --c) {
        const int state = rest % sizes_[c];
        rest /= sizes_[c];
        if (axes[c] > 1) which[mode] += state * stride, stride *= sizes_[c];
      }
    }
    return which;
  }

 private:
  std::vector<int> sizes_;
  long count_ = 1;
};

std::vector<std::int64_t> numbers(const Index& index) {
  std::vector<std::int64_t> out(index.shape(0));
  for (std::size_t i = 0; i < out.size(); ++i) out[i] = index(i);
  return out;
}

// Owns what a Model points to.
struct Held {
  Model model;
  Array array;
  std::vector<std::int64_t> rows;
  std::vector<int> which;
};

struct Reading {
  const Modes& modes;
  Size tracks, steps;
  bool timed;
};

// Read (tracks | 1, [T | 1,] M1 | 1, ..., MC | 1, *core); leading axes may be absent.
void read(Held& held, const char* name, nb::handle value, const Reading& as, const std::vector<Size>& core) {
  if (value.is_none()) return;
  nb::handle given = value;
  if (nb::isinstance<nb::tuple>(value)) {  // with the row of every track
    given = value[0].ptr();
    held.rows = numbers(nb::cast<Index>(value[1], false));
    require(Size(held.rows.size()) == as.tracks, std::string(name) + ": one row number per track is needed.");
  }
  held.array = nb::cast<Array>(given);
  const Array& a = held.array;
  const int chains = as.modes.chains(), lead = as.timed ? 2 : 1;
  const int missing = lead + chains + int(core.size()) - int(a.ndim());
  bool fits = missing >= 0;
  std::vector<Size> shape(std::max(missing, 0), 1);
  for (std::size_t i = 0; i < a.ndim(); ++i) shape.push_back(a.shape(i));
  for (std::size_t i = 0; fits && i < core.size(); ++i) fits = shape[lead + chains + i] == core[i];
  for (int c = 0; fits && c < chains; ++c)
    fits = shape[lead + c] == 1 || shape[lead + c] == as.modes.sizes()[c];
  fits = fits && (!held.rows.empty() || shape[0] == 1 || shape[0] == as.tracks);
  fits = fits && (!as.timed || shape[1] == 1 || shape[1] == as.steps);
  require(fits, std::string(name) + " has shape " + shape_of(a) +
                    ", which does not fit the chains, rows and sizes it is used with.");
  Model& model = held.model;
  for (Size s : core) model.core *= int(s);
  for (int c = 0; c < chains; ++c) model.distinct *= int(shape[lead + c]);
  const Size per_step = Size(model.distinct) * model.core;
  model.time = as.timed && shape[1] > 1 ? per_step : 0;
  model.row = shape[0] > 1 ? per_step * (as.timed ? shape[1] : 1) : 0;
  for (std::int64_t row : held.rows)
    require(row >= 0 && row < shape[0], std::string(name) + ": a row number is out of range.");
  model.rows = held.rows.empty() ? nullptr : held.rows.data();
  held.which = as.modes.table({shape.begin() + lead, shape.begin() + lead + chains});
  model.which = held.which.data();
  model.data = a.data();
}

void read_transitions(std::vector<Held>& held, std::vector<Model>& models, const nb::sequence& trans,
                      const Modes& modes, Size tracks, Size steps, bool timed) {
  const Modes none({});
  held.resize(modes.chains());
  require(Size(nb::len(trans)) == modes.chains(), "one transition matrix (or None) per chain is needed.");
  for (int c = 0; c < modes.chains(); ++c) {
    const Size size = modes.sizes()[c];
    read(held[c], "trans", trans[c], {none, tracks, steps, timed}, {size, size});
    models.push_back(held[c].model);
  }
}

double* output(const nb::handle& array, std::size_t size, const char* name) {
  if (array.is_none()) return nullptr;
  const Out out = nb::cast<Out>(array, false);
  require(out.size() == size, std::string(name) + " has the wrong size for its output.");
  return out.data();
}

void check_sizes(Size n, Size m) {
  require(n >= 1 && n <= kMostStates && m >= 1 && m <= kMostMeasured,
          "the compiled kernel takes 1 to 256 states and measured components; use backend=\"numpy\".");
}

int run_threads(const Kernel& kernel, const saltus::Problem& problem, int threads) {
  const Size blocks = (problem.n_tracks + kernel.lanes - 1) / kernel.lanes;
  threads = int(std::clamp<Size>(threads, 1, std::max<Size>(1, blocks)));
  const std::size_t space = kernel.filter_workspace(problem);
  std::vector<Workspace> workspaces;
  for (int t = 0; t < threads; ++t) workspaces.push_back(allocate(space));
  std::atomic<Size> next{0};
  std::atomic<int> status{0};
  const Size chunk = std::max<Size>(1, blocks / (Size(threads) * 16));
  auto work = [&](int t) {
    for (Size first; (first = next.fetch_add(chunk)) < blocks;)
      status |= kernel.filter(problem, first, std::min(blocks, first + chunk), workspaces[t].get());
  };
  std::vector<std::thread> pool;
  for (int t = 1; t < threads; ++t) pool.emplace_back(work, t);
  work(0);
  for (std::thread& thread : pool) thread.join();
  return status;
}

// The batch recursion. Arrays carry all their axes; outputs are written in place; returns Status bits.
int imm_filter(const std::string& isa, const Array& z, const nb::dict& model, const nb::dict& out, bool every,
               int threads) {
  require(z.ndim() == 3, "z is (tracks, T, m) here.");
  const Size tracks = z.shape(0), steps = z.shape(1), m = z.shape(2);
  const auto sizes = nb::cast<std::vector<int>>(model["sizes"]);
  const Size n = nb::cast<Size>(model["n"]);
  check_sizes(n, m);
  const Modes modes(sizes);
  const Reading timed{modes, tracks, steps, true}, prior{modes, tracks, steps, false};
  saltus::Problem p;
  Held F, b, Q, H, d, R, mean0, cov0, law0;
  read(F, "F", model["F"], timed, {n, n});
  read(b, "b", model["b"], timed, {n});
  read(Q, "Q", model["Q"], timed, {n, n});
  read(H, "H", model["H"], timed, {m, n});
  read(d, "d", model["d"], timed, {m});
  read(R, "R", model["R"], timed, {m, m});
  read(mean0, "mean0", model["mean0"], prior, {n});
  read(cov0, "cov0", model["cov0"], prior, {n, n});
  const Modes none({});
  read(law0, "log_probs0", model["log_probs0"], {none, tracks, steps, false},
       std::vector<Size>(sizes.begin(), sizes.end()));
  std::vector<Held> held;
  std::vector<Model> trans;
  read_transitions(held, trans, nb::cast<nb::sequence>(model["trans"]), modes, tracks, steps, true);
  p.n_tracks = tracks, p.n_steps = steps, p.n = int(n), p.m = int(m);
  p.modes = modes.count(), p.chains = modes.chains(), p.sizes = modes.sizes();
  p.z = z.data(), p.trans = trans.data(), p.every = every;
  p.F = F.model, p.b = b.model, p.Q = Q.model, p.H = H.model, p.d = d.model, p.R = R.model;
  p.mean0 = mean0.model, p.cov0 = cov0.model, p.log_probs0 = law0.model;
  const std::size_t rows = std::size_t(tracks) * (every ? steps : 1), M = modes.count();
  p.probs = output(out["probs"], rows * M, "probs");
  p.mean = output(out["mean"], rows * n, "mean");
  p.cov = output(out["cov"], rows * n * n, "cov");
  p.nis = output(out["nis"], rows, "nis");
  p.n_observed = output(out["n_observed"], rows, "n_observed");
  p.log_likelihood = output(out["log_likelihood"], std::size_t(tracks) * steps, "log_likelihood");
  p.mode_means = output(out["mode_means"], rows * M * n, "mode_means");
  p.mode_covs = output(out["mode_covs"], rows * M * n * n, "mode_covs");
  const Kernel& kernel = kernel_of(isa);
  nb::gil_scoped_release release;
  return run_threads(kernel, p, threads);
}

// Beliefs in lanes. Which rows are in use, hence hold anything, is the caller's affair; row numbers are checked here.
class Bank {
 public:
  Bank(const std::string& isa, int n, const std::vector<int>& sizes, Size capacity)
      : kernel_(kernel_of(isa)), modes_(sizes) {
    check_sizes(n, 1);
    tracks_.n = n, tracks_.modes = modes_.count(), tracks_.chains = modes_.chains(), tracks_.sizes = modes_.sizes();
    grow(capacity);
  }

  void grow(Size capacity) {
    const std::size_t size = kernel_.block_size(tracks_);
    const Size blocks = (capacity + kernel_.lanes - 1) / kernel_.lanes, old = blocks_;
    if (blocks <= old && data_) return;
    Workspace data = allocate(size * blocks);
    if (data_) std::memcpy(data.get(), data_.get(), size * old * sizeof(double));
    data_ = std::move(data);
    blocks_ = blocks;
    tracks_.data = data_.get();
  }

  void step(const Index& index, const nb::sequence& trans, nb::handle F, nb::handle b, nb::handle Q) {
    const std::vector<std::int64_t> held_rows = checked(index);
    const saltus::Rows rows{held_rows.data(), Size(held_rows.size())};
    const Reading as{modes_, rows.count, 1, false};
    const Size n = tracks_.n;
    Held f, u, q;
    read(f, "F", F, as, {n, n});
    read(u, "b", b, as, {n});
    read(q, "Q", Q, as, {n, n});
    std::vector<Held> held;
    std::vector<Model> chains;
    read_transitions(held, chains, trans, modes_, rows.count, 1, false);
    kernel_.bank_step(tracks_, rows, chains.data(), f.model, u.model, q.model, space(1));
  }

  int measure(const Index& index, bool write, const Array& z, nb::handle H, nb::handle d, nb::handle R, const Out& d2,
              const Out& log_likelihood) {
    const std::vector<std::int64_t> held_rows = checked(index);
    const saltus::Rows rows{held_rows.data(), Size(held_rows.size())};
    const Reading as{modes_, rows.count, 1, false};
    require(z.ndim() == 2 && Size(z.shape(0)) == rows.count,
            "z has shape " + shape_of(z) + "; it is (k, m) with one measurement per row addressed.");
    const Size n = tracks_.n, m = z.shape(1);
    check_sizes(n, m);
    require(Size(d2.size()) == rows.count && Size(log_likelihood.size()) == rows.count, "outputs are (k,).");
    Held h, o, r;
    read(h, "H", H, as, {m, n});
    read(o, "d", d, as, {m});
    read(r, "R", R, as, {m, m});
    return kernel_.bank_measure(tracks_, rows, write, int(m), z.data(), h.model, o.model, r.model, d2.data(),
                                log_likelihood.data(), space(int(m)));
  }

  void moments(const Index& index, nb::handle mean, nb::handle cov, nb::handle probs) {
    const std::vector<std::int64_t> held_rows = checked(index);
    const saltus::Rows rows{held_rows.data(), Size(held_rows.size())};
    const std::size_t n = tracks_.n, k = rows.count;
    kernel_.bank_moments(tracks_, rows, output(mean, k * n, "mean"), output(cov, k * n * n, "cov"),
                         output(probs, k * tracks_.modes, "probs"), space(1));
  }

  void read_rows(const Index& index, nb::handle log_probs, nb::handle means, nb::handle covs) {
    const std::vector<std::int64_t> held_rows = checked(index);
    const saltus::Rows rows{held_rows.data(), Size(held_rows.size())};
    const std::size_t n = tracks_.n, k = std::size_t(rows.count) * tracks_.modes;
    kernel_.bank_read(tracks_, rows, output(log_probs, k, "log_probs"), output(means, k * n, "means"),
                      output(covs, k * n * n, "covs"), space(1));
  }

  void write_rows(const Index& index, const Array& log_probs, const Array& means, const Array& covs) {
    const std::vector<std::int64_t> held_rows = checked(index);
    const saltus::Rows rows{held_rows.data(), Size(held_rows.size())};
    const std::size_t n = tracks_.n, k = std::size_t(rows.count) * tracks_.modes;
    require(log_probs.size() == k && means.size() == k * n && covs.size() == k * n * n,
            "a belief of this bank has log_probs (k, M1, ..., MC), means (..., n), covs (..., n, n); got " +
                shape_of(log_probs) + ", " + shape_of(means) + ", " + shape_of(covs) + ".");
    kernel_.bank_write(tracks_, rows, log_probs.data(), means.data(), covs.data());
  }

  void copy_from(const Index& target, const Bank& other, const Index& source) {
    const std::vector<std::int64_t> to = checked(target), from = other.checked(source);
    require(tracks_.n == other.tracks_.n && tracks_.modes == other.tracks_.modes && to.size() == from.size() &&
                &kernel_ == &other.kernel_,
            "rows are copied between banks of the same n, chains and instruction set, as many as there are.");
    kernel_.bank_copy(other.tracks_, {from.data(), Size(from.size())}, tracks_, {to.data(), Size(to.size())});
  }

 private:
  std::vector<std::int64_t> checked(const Index& index) const {
    std::vector<std::int64_t> rows = numbers(index);
    for (std::int64_t row : rows)
      if (row < 0 || row >= blocks_ * kernel_.lanes)
        throw nb::index_error(("row " + std::to_string(row) + " is not in this bank.").c_str());
    return rows;
  }

  // Grows with the largest measurement seen, and serves every call.
  double* space(int m) {
    const std::size_t needed = kernel_.bank_workspace(tracks_, m);
    if (needed > space_size_) {
      workspace_ = allocate(needed);
      space_size_ = needed;
    }
    return workspace_.get();
  }

  const Kernel& kernel_;
  Modes modes_;
  saltus::Tracks tracks_;
  Workspace data_, workspace_;
  Size blocks_ = 0;
  std::size_t space_size_ = 0;
};

}  // namespace

NB_MODULE(_native, module) {
  module.doc() = "Compiled twins of saltus.filters.";
  module.def("instruction_sets", &instruction_sets);
  module.def("lanes", [](const std::string& isa) { return kernel_of(isa).lanes; });
  module.def("multiply_adds", [](const std::string& isa, std::int64_t rounds) {
    const Kernel& kernel = kernel_of(isa);
    nb::gil_scoped_release release;
    return kernel.multiply_adds(rounds);
  });
  module.def("imm_filter", &imm_filter, nb::arg("isa"), nb::arg("z"), nb::arg("model"), nb::arg("out"),
             nb::arg("every"), nb::arg("threads"));
  const auto rows = nb::arg().noconvert();
  nb::class_<Bank>(module, "Bank")
      .def(nb::init<const std::string&, int, const std::vector<int>&, Size>())
      .def("grow", &Bank::grow)
      .def("step", &Bank::step, rows, nb::arg(), nb::arg(), nb::arg().none(), nb::arg())
      .def("measure", &Bank::measure, rows, nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg(),
           nb::arg().noconvert(), nb::arg().noconvert())
      .def("moments", &Bank::moments, rows, nb::arg(), nb::arg(), nb::arg())
      .def("read", &Bank::read_rows, rows, nb::arg(), nb::arg(), nb::arg())
      .def("write", &Bank::write_rows, rows, nb::arg(), nb::arg(), nb::arg())
      .def("copy_from", &Bank::copy_from, rows, nb::arg(), rows);
}
