// The binding of the ASTERIX codec: tables and buffers are checked here, and nowhere below.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <stdexcept>
#include <vector>

#include "asterix_columns.hpp"
#include "asterix_pack.hpp"
#include "asterix_walk.hpp"

namespace nb = nanobind;

namespace {

using namespace saltus::asterix;
using Bytes = nb::ndarray<const std::uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Longs = nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Ints = nb::ndarray<const std::int32_t, nb::c_contig, nb::device::cpu>;
using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Any = nb::ndarray<nb::c_contig, nb::device::cpu>;

// An array that owns a vector.
template <class T>
nb::object array_of(std::vector<T>&& values) {
  auto* held = new std::vector<T>(std::move(values));
  nb::capsule owner(held, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return nb::cast(nb::ndarray<nb::numpy, T, nb::ndim<1>>(held->data(), {held->size()}, owner));
}

// The tables of a program; they borrow from its arrays.
struct Program {
  Ints nodes, index, roots, select, profiles, slots, guards;
  Doubles scale;
  Tables tables;

  explicit Program(nb::handle program)
      : nodes(nb::cast<Ints>(program.attr("nodes"))),
        index(nb::cast<Ints>(program.attr("index"))),
        roots(nb::cast<Ints>(program.attr("roots"))),
        select(nb::cast<Ints>(program.attr("select"))),
        profiles(nb::cast<Ints>(program.attr("profiles"))),
        slots(nb::cast<Ints>(program.attr("slots"))),
        guards(nb::cast<Ints>(program.attr("guards"))),
        scale(nb::cast<Doubles>(program.attr("scale"))) {
    tables = {reinterpret_cast<const Node*>(nodes.data()),
              index.data(),
              roots.data(),
              int(roots.size()),
              select.size() ? select.data() : nullptr,
              profiles.data(),
              int(profiles.size() / 2),
              reinterpret_cast<const Slot*>(slots.data()),
              reinterpret_cast<const Scale*>(scale.data()),
              reinterpret_cast<const Guard*>(guards.data()),
              nb::cast<int>(program.attr("required"))};
  }
};

void require(bool condition, const char* message) {
  if (!condition) throw std::invalid_argument(message);
}

nb::tuple find(const Bytes& data, const Longs& offset, const Longs& length, nb::handle program, bool strict) {
  const Program held(program);
  require(offset.size() == length.size(), "one length for each offset is needed.");
  const std::int64_t n_bytes = std::int64_t(data.size());
  for (std::size_t b = 0; b < offset.size(); ++b)
    require(offset(b) >= 0 && length(b) >= 0 && length(b) <= n_bytes && offset(b) <= n_bytes - length(b),
            "blocks must lie in the buffer.");
  std::vector<std::int64_t> records[5], faults[7];
  {
    nb::gil_scoped_release release;
    Measure nothing;
    Walker<Measure> walker(data.data(), held.tables, strict, nothing);
    for (std::size_t b = 0; b < offset.size(); ++b) {
      const std::int64_t end = offset(b) + length(b);
      std::int64_t position = offset(b) + 3;
      for (std::int64_t number = 0; position < end;) {
        const std::int64_t stop = walker.record(position, end);
        const bool kept = stop >= 0 || walker.keeps();
        const std::int64_t mine = kept ? std::int64_t(records[0].size()) : -1;
        if (stop < 0) walker.notes.push_back(walker.fault);
        for (const Fault& f : walker.notes) {
          const std::int64_t row[7] = {std::int64_t(b), f.position, f.code, f.node, f.need, end - f.position, mine};
          for (int k = 0; k < 7; ++k) faults[k].push_back(row[k]);
        }
        if (kept) {
          const std::int64_t row[5] = {std::int64_t(b), number++, position, stop < 0 ? end : stop, walker.profile};
          for (int k = 0; k < 5; ++k) records[k].push_back(row[k]);
        }
        position = stop < 0 ? end : stop;
      }
    }
  }
  nb::list found, broken;
  for (auto& column : records) found.append(array_of(std::move(column)));
  for (auto& column : faults) broken.append(array_of(std::move(column)));
  return nb::make_tuple(found, broken);
}

// Dense columns are written into (values, present); for None a pair of new arrays, bytes of values and rows, comes back.
nb::list extract(const Bytes& data, const Longs& start, const Longs& stop, nb::handle program, nb::list dense,
                 const std::vector<int>& widths) {
  const Program held(program);
  require(start.size() == stop.size(), "one stop for each start is needed.");
  for (std::size_t r = 0; r < start.size(); ++r)
    require(start(r) >= 0 && start(r) <= stop(r) && stop(r) <= std::int64_t(data.size()),
            "records must lie in the buffer.");
  require(dense.size() == widths.size(), "one width for each output is needed.");
  std::vector<Output> outputs(dense.size());
  std::vector<Any> borrowed;
  for (std::size_t k = 0; k < outputs.size(); ++k) {
    outputs[k].width = widths[k];
    if (dense[k].is_none()) continue;
    Any values = nb::cast<Any>(dense[k][0]), present = nb::cast<Any>(dense[k][1]);
    require(values.nbytes() == start.size() * std::size_t(widths[k]) && present.nbytes() == start.size(),
            "an output must have a place for each record.");
    outputs[k].values = values.data();
    outputs[k].present = static_cast<std::uint8_t*>(present.data());
    borrowed.push_back(values), borrowed.push_back(present);
  }
  {
    nb::gil_scoped_release release;
    Columns columns(data.data(), held.tables, outputs);
    Walker<Columns> walker(data.data(), held.tables, false, columns);
    for (std::size_t r = 0; r < start.size(); ++r) {
      columns.row = std::int64_t(r);
      walker.record(start(r), stop(r));
    }
  }
  nb::list found;
  for (Output& out : outputs) {
    if (out.present)
      found.append(nb::none());
    else
      found.append(nb::make_tuple(array_of(std::move(out.many)), array_of(std::move(out.rows))));
  }
  return found;
}

nb::tuple pack(nb::handle program, nb::list columns, std::int64_t n, int profile) {
  const Program held(program);
  std::vector<Input> inputs(columns.size());
  std::vector<Longs> longs;
  std::vector<Any> flags;
  for (std::size_t k = 0; k < inputs.size(); ++k) {
    longs.push_back(nb::cast<Longs>(columns[k][0]));
    inputs[k].values = longs.back().data();
    if (!columns[k][1].is_none()) {
      flags.push_back(nb::cast<Any>(columns[k][1]));
      require(std::int64_t(flags.back().nbytes()) == n, "one flag for each record is needed.");
      inputs[k].present = static_cast<const std::uint8_t*>(flags.back().data());
    }
    if (!columns[k][2].is_none()) {
      longs.push_back(nb::cast<Longs>(columns[k][2]));
      require(std::int64_t(longs.back().size()) == n + 1, "the values of each record need a start, and an end.");
      inputs[k].first = longs.back().data();
    }
  }
  require(profile >= 0 && profile < held.tables.n_roots, "there is no such profile.");
  Packer packer(held.tables, inputs);
  std::vector<std::int64_t> start(std::size_t(n + 1));
  {
    nb::gil_scoped_release release;
    for (std::int64_t row = 0; row < n && packer.overflow < 0; ++row) {
      packer.put(held.tables.roots[profile], row);
      start[row + 1] = std::int64_t(packer.bytes.size());
    }
  }
  return nb::make_tuple(nb::bytes(packer.bytes.data(), packer.bytes.size()), array_of(std::move(start)),
                        packer.overflow);
}

}  // namespace

void add_asterix(nb::module_& module) {
  module.def("asterix_find", &find, nb::arg("data").noconvert(), nb::arg("offset").noconvert(),
             nb::arg("length").noconvert(), nb::arg("program"), nb::arg("strict"));
  module.def("asterix_extract", &extract, nb::arg("data").noconvert(), nb::arg("start").noconvert(),
             nb::arg("stop").noconvert(), nb::arg("program"), nb::arg("dense"), nb::arg("widths"));
  module.def("asterix_pack", &pack, nb::arg("program"), nb::arg("columns"), nb::arg("n"), nb::arg("profile"));
}
