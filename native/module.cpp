// The binding: checks shapes, lets the interpreter go, spreads blocks over threads. Compiled for the baseline only.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <string>
#include <system_error>
#include <thread>
#include <vector>

#include "arguments.hpp"

void add_asterix(nanobind::module_& module);
void bind_asterix_frames(nanobind::module_& module);

namespace {

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
  try {
    for (int t = 1; t < threads; ++t) pool.emplace_back(work, t);
  } catch (const std::system_error&) {
    // The system has no more threads to give: those there are do the work.
  }
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
  saltus::Problem p;
  p.reported = nb::cast<int>(model["reported"]), p.start = nb::cast<bool>(model["from_first"]);
  require(steps > p.start, "there is no measurement after the first.");
  const Modes modes(sizes);
  const Reading moving{modes, tracks, steps - p.start, true}, timed{modes, tracks, steps, true};
  const Reading prior{modes, tracks, steps, false};
  Held F, b, Q, H, d, R, map, mean0, cov0, law0;
  read(map, "map", model["map"], prior, {n, n});
  read(F, "F", model["F"], moving, {n, n});
  read(b, "b", model["b"], moving, {n});
  read(Q, "Q", model["Q"], moving, {n, map.model.data ? n + 2 * m : n});
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
  read_transitions(held, trans, nb::cast<nb::sequence>(model["trans"]), modes, tracks, steps - p.start, true);
  p.n_tracks = tracks, p.n_steps = steps, p.n = int(n), p.m = int(m);
  p.modes = modes.count(), p.chains = modes.chains(), p.sizes = modes.sizes();
  p.z = z.data(), p.trans = trans.data(), p.every = every;
  p.F = F.model, p.b = b.model, p.Q = Q.model, p.H = H.model, p.d = d.model, p.R = R.model;
  p.known = map.model.data ? int(m) : 0, p.map = map.model;
  require(!p.known || (p.start && m < n), "map needs a prior at the first row, and fewer measured components than states.");
  require(!p.map.row, "map is one for all runs.");
  require(p.reported >= 1 && p.reported <= n - p.known, "reported is from 1 to the number of components kept.");
  p.mean0 = mean0.model, p.cov0 = cov0.model, p.log_probs0 = law0.model;
  const std::size_t rows = std::size_t(tracks) * (every ? steps : 1), M = modes.count(), r = p.reported;
  p.probs = output(out["probs"], rows * M, "probs");
  p.mean = output(out["mean"], rows * r, "mean");
  p.cov = output(out["cov"], rows * r * r, "cov");
  p.nis = output(out["nis"], rows, "nis");
  p.n_observed = output(out["n_observed"], rows, "n_observed");
  p.log_likelihood = output(out["log_likelihood"], std::size_t(tracks) * steps, "log_likelihood");
  p.mode_means = output(out["mode_means"], rows * M * r, "mode_means");
  p.mode_covs = output(out["mode_covs"], rows * M * r * r, "mode_covs");
  p.faults = faults(out["faults"], tracks);
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

  int step(const Index& index, const nb::sequence& trans, nb::handle F, nb::handle b, nb::handle Q) {
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
    return kernel_.bank_step(tracks_, rows, chains.data(), f.model, u.model, q.model, space(1));
  }

  nb::tuple measure(const Index& index, bool write, const Array& z, nb::handle H, nb::handle d, nb::handle R, const Out& d2,
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
    return told(kernel_.bank_measure(tracks_, rows, write, int(m), z.data(), h.model, o.model, r.model, d2.data(),
                                     log_likelihood.data(), space(int(m))));
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

  // Law of the next mode of every row, and log f(z); `same` names for each mode the first with the same dynamics.
  nb::tuple expand(const Index& index, const Index& now, const Index& same, const Array& trans, const Array& z, nb::handle F,
             nb::handle b, nb::handle Q, nb::handle H, nb::handle d, nb::handle R, const Out& law,
             const Out& log_likelihood) {
    const std::vector<std::int64_t> held_rows = checked(index), modes_now = numbers(now), first = numbers(same);
    const saltus::Rows rows{held_rows.data(), Size(held_rows.size())};
    const Size M = Size(first.size()), n = tracks_.n, m = z.ndim() == 2 ? Size(z.shape(1)) : 0;
    require(tracks_.chains == 0, "particles are rows of a bank without chains.");
    require(M >= 1 && M <= kMostModes && trans.size() == std::size_t(M * M), "trans is (modes, modes).");
    require(m && Size(z.shape(0)) == rows.count, "z has shape " + shape_of(z) + "; it is (k, m), a row per particle.");
    check_sizes(n, m);
    require(Size(modes_now.size()) == rows.count, "one present mode per particle is needed.");
    require(all_below(modes_now, M), "a mode number is out of range.");
    for (Size j = 0; j < M; ++j)
      require(first[j] >= 0 && first[j] <= j && first[first[j]] == first[j], "same names no mode before its own.");
    require(Size(law.size()) == rows.count * M && Size(log_likelihood.size()) == rows.count,
            "outputs are (k, modes) and (k,).");
    const Modes modes({int(M)});
    const Reading as{modes, 1, 1, false};
    Held f, u, q, h, o, r;
    read(f, "F", F, as, {n, n});
    read(u, "b", b, as, {n});
    read(q, "Q", Q, as, {n, n});
    read(h, "H", H, as, {m, n});
    read(o, "d", d, as, {m});
    read(r, "R", R, as, {m, m});
    const saltus::Branches to{int(M), trans.data(), modes_now.data(), first.data()};
    double* workspace = room(kernel_.expand_workspace(tracks_, int(M), int(m)));
    return told(kernel_.bank_expand(tracks_, rows, to, int(m), z.data(), f.model, u.model, q.model, h.model, o.model,
                                    r.model, law.data(), log_likelihood.data(), workspace));
  }

  void merge(const Index& index, const Array& weight, const Index& label, const Out& mass, const Out& means,
             const Out& covs) {
    const std::vector<std::int64_t> held_rows = checked(index), labels = numbers(label);
    const Size k = Size(held_rows.size()), L = Size(mass.size()), n = tracks_.n;
    require(tracks_.chains == 0, "particles are rows of a bank without chains.");
    require(Size(weight.size()) == k && Size(labels.size()) == k, "one weight and one label per row are needed.");
    require(Size(means.size()) == L * n && Size(covs.size()) == L * n * n, "outputs are (L,), (L, n), (L, n, n).");
    require(all_below(labels, L), "a label is out of range.");
    std::vector<double> totals(L * (1 + n + n * n));
    kernel_.bank_merge(tracks_, {held_rows.data(), k}, weight.data(), labels.data(), L, mass.data(), means.data(),
                       covs.data(), totals.data(), space(1));
  }

  void merge_copies(const Index& index, const Bank& copies, const Index& begins, const Array& log_weight) {
    const std::vector<std::int64_t> to = checked(index), start = numbers(begins);
    const Size k = Size(to.size()), c = Size(log_weight.size());
    require(tracks_.n == copies.tracks_.n && tracks_.modes == copies.tracks_.modes && &kernel_ == &copies.kernel_ &&
                this != &copies,
            "copies are of another bank of the same n, chains and instruction set.");
    require(Size(start.size()) == k + 1 && c <= copies.blocks_ * kernel_.lanes, "start is (k + 1,), a copy per weight.");
    require(start[0] >= 0 && start[k] <= c, "start runs from 0 to the number of copies.");
    for (Size i = 0; i < k; ++i) require(start[i] < start[i + 1], "every row has a copy.");
    kernel_.bank_merge_copies(copies.tracks_, start.data(), log_weight.data(), tracks_, {to.data(), k}, space(1));
  }

  void copy_from(const Index& target, const Bank& other, const Index& source) {
    const std::vector<std::int64_t> to = checked(target), from = other.checked(source);
    require(tracks_.n == other.tracks_.n && tracks_.modes == other.tracks_.modes && to.size() == from.size() &&
                &kernel_ == &other.kernel_,
            "rows are copied between banks of the same n, chains and instruction set, as many as there are.");
    kernel_.bank_copy(other.tracks_, {from.data(), Size(from.size())}, tracks_, {to.data(), Size(to.size())});
  }

 private:
  static nb::tuple told(const saltus::Fault& fault) { return nb::make_tuple(fault.kind, fault.row, fault.component); }

  std::vector<std::int64_t> checked(const Index& index) const {
    std::vector<std::int64_t> rows = numbers(index);
    for (std::int64_t row : rows)
      if (row < 0 || row >= blocks_ * kernel_.lanes)
        throw nb::index_error(("row " + std::to_string(row) + " is not in this bank.").c_str());
    return rows;
  }

  // Grows with the largest measurement seen, and serves every call.
  double* space(int m) { return room(kernel_.bank_workspace(tracks_, m)); }

  double* room(std::size_t needed) {
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
  module.doc() = "Compiled twins of saltus.filters, saltus.asterix, saltus.framing.";
  add_asterix(module);
  bind_asterix_frames(module);
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
      .def("expand", &Bank::expand, rows, rows, rows, nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg(),
           nb::arg(), nb::arg().none(), nb::arg(), nb::arg().noconvert(), nb::arg().noconvert())
      .def("merge", &Bank::merge, rows, nb::arg(), rows, nb::arg().noconvert(), nb::arg().noconvert(),
           nb::arg().noconvert())
      .def("merge_copies", &Bank::merge_copies, rows, nb::arg(), rows, nb::arg())
      .def("copy_from", &Bank::copy_from, rows, nb::arg(), rows);
}
