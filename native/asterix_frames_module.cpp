// The binding of the framing: bytes in, arrays of blocks out.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "asterix_frames.hpp"

namespace nb = nanobind;
using namespace saltus::frames;

namespace {

using Bytes = nb::ndarray<const Byte, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

template <class T>
nb::object array(std::vector<T>&& values) {
  auto* kept = new std::vector<T>(std::move(values));
  nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return nb::cast(nb::ndarray<nb::numpy, T, nb::ndim<1>>(kept->data(), {kept->size()}, owner));
}

Container container(const nb::tuple& t) {
  Container c;
  c.header = nb::cast<Size>(t[0]), c.trailer = nb::cast<Size>(t[1]), c.length_at = nb::cast<Size>(t[2]);
  c.little = nb::cast<bool>(t[3]), c.whole = nb::cast<bool>(t[4]), c.checked = nb::cast<bool>(t[5]);
  c.fill = nb::cast<int>(t[6]), c.idle = nb::cast<int>(t[7]);
  const auto opening = nb::cast<nb::bytes>(t[8]);
  c.opening.assign(opening.c_str(), opening.size());
  c.clock_at = nb::cast<Size>(t[9]), c.clock_bytes = nb::cast<Size>(t[10]), c.clock_step = nb::cast<double>(t[11]);
  c.clock_little = nb::cast<bool>(t[12]), c.channel_at = nb::cast<Size>(t[13]);
  return c;
}

Known known_of(const Bytes& mask) {
  if (mask.shape(0) != 256) throw nb::value_error("known has 256 entries");
  Known known;
  for (int k = 0; k < 256; ++k) known[k] = mask.data()[k] != 0;
  return known;
}

void check(const Bytes& data, Size start, Size stop) {
  if (start < 0 || start > stop || stop > Size(data.shape(0))) throw nb::value_error("start and stop lie within data");
}

nb::tuple scan_frames(const Bytes& data, Size start, Size stop, const nb::tuple& kind, const Bytes& known) {
  check(data, start, stop);
  const Container c = container(kind);
  const Known mask = known_of(known);
  Scan out;
  {
    nb::gil_scoped_release release;
    out = scan(data.data(), start, stop, c, mask);
  }
  Blocks& b = out.blocks;
  return nb::make_tuple(array(std::move(b.offset)), array(std::move(b.length)), array(std::move(b.category)),
                        array(std::move(b.clock)), array(std::move(b.channel)), array(std::move(b.frame)),
                        out.position, out.broken, out.frames, out.foreign, out.foreign_at);
}

bool holds_frames(const Bytes& data, Size start, Size stop, const nb::tuple& kind, const Bytes& known, int count) {
  check(data, start, stop);
  return holds(data.data(), start, stop, container(kind), known_of(known), count);
}

Size find_frames(const Bytes& data, Size start, Size last, Size stop, const nb::tuple& kind, const Bytes& known,
                 int count) {
  check(data, start, stop);
  const Container c = container(kind);
  const Known mask = known_of(known);
  nb::gil_scoped_release release;
  return find(data.data(), start, last, stop, c, mask, count);
}

nb::tuple scan_capture(Capture& capture, const Bytes& data, Size start, Size stop, Size base) {
  check(data, start, stop);
  Capture::Taken out;
  {
    nb::gil_scoped_release release;
    out = capture.scan(data.data(), start, stop, base);
  }
  Blocks& b = out.blocks;
  return nb::make_tuple(array(std::move(b.offset)), array(std::move(b.length)), array(std::move(b.category)),
                        array(std::move(b.clock)), array(std::move(b.channel)), array(std::move(b.cut)),
                        array(std::move(b.at)), nb::bytes(out.extra.data(), out.extra.size()), out.position, out.last,
                        out.broken);
}

nb::dict passed(const Capture& capture) {
  nb::dict counts;
  for (const auto& [key, value] : capture.passed())
    counts[nb::make_tuple(key.first, key.second)] = nb::make_tuple(value.first, value.second);
  return counts;
}

nb::list channels(const Capture& capture) {
  nb::list names;
  for (const std::string& name : capture.channels()) names.append(nb::bytes(name.data(), name.size()));
  return names;
}

}  // namespace

void bind_asterix_frames(nb::module_& module) {
  const auto data = nb::arg().noconvert();
  module.def("scan_frames", &scan_frames, data, nb::arg(), nb::arg(), nb::arg(), nb::arg());
  module.def("holds_frames", &holds_frames, data, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg());
  module.def("find_frames", &find_frames, data, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg());
  nb::class_<Capture>(module, "Capture")
      .def("__init__",
           [](Capture* self, const nb::list& inside, const Bytes& known) {
             std::vector<Container> kinds;
             for (const nb::handle kind : inside) kinds.push_back(container(nb::cast<nb::tuple>(kind)));
             new (self) Capture(std::move(kinds), known_of(known));
           })
      .def("begin", [](Capture& self, const nb::bytes& head) {
        return self.begin(reinterpret_cast<const Byte*>(head.c_str()), Size(head.size()));
      })
      .def("scan", &scan_capture, data, nb::arg(), nb::arg(), nb::arg())
      .def("record", [](Capture& self, const Bytes& bytes, Size position, Size stop) {
        check(bytes, position, stop);
        return self.record(bytes.data(), position, stop);
      })
      .def("finish", &Capture::finish)
      .def_prop_ro("passed", &passed)
      .def_prop_ro("channels", &channels);
}
