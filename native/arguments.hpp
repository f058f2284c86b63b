// Arguments from Python: shapes are read and checked here, and nowhere below. Included by module.cpp alone.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <string>
#include <utility>
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

bool all_below(const std::vector<std::int64_t>& numbers, std::int64_t limit) {
  return std::all_of(numbers.begin(), numbers.end(), [limit](std::int64_t i) { return i >= 0 && i < limit; });
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
  require(all_below(held.rows, shape[0]), std::string(name) + ": a row number is out of range.");
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

// (tracks, 3): kind, row, component.
saltus::Fault* faults(const nb::handle& array, Size tracks) {
  const auto out = nb::cast<nb::ndarray<std::int64_t, nb::c_contig, nb::device::cpu>>(array, false);
  require(Size(out.size()) == 3 * tracks, "faults has the wrong size for its output.");
  return reinterpret_cast<saltus::Fault*>(out.data());
}

void check_sizes(Size n, Size m) {
  require(n >= 1 && n <= kMostStates && m >= 1 && m <= kMostMeasured,
          "the compiled kernel takes 1 to 256 states and measured components; use backend=\"numpy\".");
}

}  // namespace
