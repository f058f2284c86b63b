// Walks ASTERIX records: the compiled twin of Walker in saltus/asterix/walk.py.
#pragma once

#include <vector>

#include "asterix.hpp"

namespace saltus::asterix {

struct Fault {
  std::int64_t code, position, node, need;
};

// What a walk that only measures does with the nodes it meets.
struct Measure {
  static constexpr bool kKeeps = false;
  void whole(int, std::int64_t, std::int64_t) {}
  void one(int, std::int64_t, std::int64_t) {}
};

// Calls sink.one(node, start, stop) for each item with fields (each repetition of one), sink.whole(...) for each item.
// No byte before `start` or from `end` on is read, whatever the bytes say.
template <class Sink>
class Walker {
 public:
  Walker(const std::uint8_t* data, const Tables& tables, bool strict, Sink& sink)
      : data_(data), t_(tables), strict_(strict), sink_(sink) {
    for (int r = 0; r < t_.n_roots; ++r)
      if (t_.nodes[t_.roots[r]].size > longest_) longest_ = t_.nodes[t_.roots[r]].size;
  }

  // Walks the record at `start`; returns where it stops, or -1 with `fault` set.
  std::int64_t record(std::int64_t start, std::int64_t end) {
    notes.clear();
    profile = t_.select ? -1 : 0;
    source_ = t_.required < 0;
    root_ = t_.roots[0];
    const std::int64_t flags_stop = flags(root_, start, end, longest_);
    if (flags_stop < 0) return -1;
    std::int64_t position = flags_stop;
    for (std::int64_t byte = start; byte < flags_stop; ++byte) {
      for (unsigned octet = data_[byte] & 0xFEu; octet;) {
        const int bit = __builtin_clz(octet) - 24;
        octet &= ~(0x80u >> bit);
        position = item(int(7 * (byte - start)) + bit, start, position, end);
        if (position < 0) return -1;
      }
    }
    if (profile < 0) return fails(kNoProfile, start, t_.select[0], -1);
    if (!source_) return fails(kNoSource, start, t_.required, 0);
    return position;
  }

  // Whether a record is worth keeping although it broke off: all but a field of its own length was read.
  bool keeps() const { return t_.nodes[fault.node].kind == kExplicit && source_ && profile >= 0; }

  Fault fault{};
  std::vector<Fault> notes;  // of items skipped in a record that goes on
  int profile = 0;

 private:
  std::int64_t fails(Code code, std::int64_t position, int node, std::int64_t need) {
    fault = {code, position, node, need};
    return -1;
  }

  std::int64_t item(int bit, std::int64_t start, std::int64_t position, std::int64_t end) {
    const int node = child(root_, bit, start);
    if (node < 0) return -1;
    const std::int64_t stop = walk(node, position, end);
    if (stop < 0) return -1;
    source_ |= node == t_.required;
    if (t_.select && node == t_.select[0]) {
      const std::int64_t value = std::int64_t(bits(data_ + position, data_ + stop, t_.select[1], t_.select[2]));
      profile = -1;
      for (int p = 0; p < t_.n_profiles; ++p)
        if (t_.profiles[2 * p] == value) profile = t_.profiles[2 * p + 1];
      if (profile < 0) return fails(kNoProfile, position, node, value);
      root_ = t_.roots[profile];
    }
    return stop;
  }

  std::int64_t flags(int node, std::int64_t start, std::int64_t end, int longest) {
    for (std::int64_t position = start;; ++position) {
      if (position >= end) return fails(kEndless, start, node, 0);
      if (position - start >= longest) return fails(kLong, start, node, longest);
      if (!(data_[position] & 1)) return position + 1;
    }
  }

  int child(int node, int bit, std::int64_t start) {
    const Node& n = t_.nodes[node];
    const int found = bit < n.count ? t_.index[n.first + bit] : -1;
    return found < 0 ? int(fails(kUndefined, start, node, bit + 1)) : found;
  }

  std::int64_t walk(int node, std::int64_t start, std::int64_t end) {
    const Node& n = t_.nodes[node];
    std::int64_t stop = -1;
    switch (n.kind) {
      case kFixed:
        stop = within(node, start, start + n.size, end);
        break;
      case kExtended:
        stop = extended(node, start, end);
        break;
      case kRepeated:
        stop = repeated(node, start, end);
        if (stop >= 0 && n.slots) sink_.whole(node, start, stop);
        return stop;
      case kExplicit:
        stop = explicit_length(node, start, end);
        return stop;
      case kCompound:
        stop = compound(node, start, end);
        if (stop >= 0 && n.slots) sink_.whole(node, start, stop);
        return stop;
      default:
        return random(node, start, end);
    }
    if (stop >= 0 && n.slots) sink_.whole(node, start, stop), sink_.one(node, start, stop);
    return stop;
  }

  std::int64_t within(int node, std::int64_t start, std::int64_t stop, std::int64_t end) {
    return stop > end ? fails(kShort, start, node, stop - start) : stop;
  }

  std::int64_t extended(int node, std::int64_t start, std::int64_t end) {
    const Node& n = t_.nodes[node];
    std::int64_t stop = start;
    for (int k = 0; k < n.count; ++k) {
      const int part = t_.index[n.first + k];
      stop = within(node, start, stop + (part < 0 ? -part : part), end);
      if (stop < 0 || part < 0 || !(data_[stop - 1] & 1)) return stop;
    }
    if (strict_) return fails(kBeyond, start, node, 0);
    notes.push_back({kBeyond, start, node, 0});
    while (data_[stop - 1] & 1) {
      stop = within(node, start, stop + 1, end);
      if (stop < 0) return -1;
    }
    return stop;
  }

  std::int64_t repeated(int node, std::int64_t start, std::int64_t end) {
    const Node& n = t_.nodes[node];
    const int count_bytes = t_.index[n.first];
    std::int64_t stop = within(node, start, start + count_bytes, end);
    if (stop < 0) return -1;
    if (count_bytes == 0) {
      do {
        stop = within(node, start, stop + n.size, end);
        if (stop < 0) return -1;
        if (n.slots) sink_.one(node, stop - n.size, stop);
      } while (data_[stop - 1] & 1);
      return stop;
    }
    std::int64_t count = 0;
    for (int k = 0; k < count_bytes; ++k) count = count << 8 | data_[start + k];
    if (within(node, start, stop + count * n.size, end) < 0) return -1;
    if (!n.slots) return stop + count * n.size;
    for (; count; --count, stop += n.size) sink_.one(node, stop, stop + n.size);
    return stop;
  }

  std::int64_t explicit_length(int node, std::int64_t start, std::int64_t end) {
    const Node& n = t_.nodes[node];
    if (within(node, start, start + 1, end) < 0) return -1;
    const int length = data_[start];
    if (length == 0) return fails(kEmpty, start, node, 0);
    const std::int64_t stop = within(node, start, start + length, end);
    if (stop < 0) return -1;
    if (n.slots) sink_.whole(node, start, stop);
    if (n.count == 0) return stop;
    const int inner = t_.index[n.first];
    Measure nothing;
    Walker<Measure> probe(data_, t_, strict_, nothing);
    if (probe.content(inner, start + 1, stop) != stop) {
      notes.push_back({kContent, start, node, 0});
    } else {
      notes.insert(notes.end(), probe.notes.begin(), probe.notes.end());
      if constexpr (Sink::kKeeps) {
        const std::size_t known = notes.size();
        content(inner, start + 1, stop);
        notes.resize(known);
      }
    }
    return stop;
  }

  std::int64_t content(int node, std::int64_t start, std::int64_t end) {
    const Node& n = t_.nodes[node];
    std::int64_t stop = within(node, start, start + n.size, end);
    for (int bit = 0; stop >= 0 && bit < 8 * n.size; ++bit)
      if (data_[start + bit / 8] & (0x80 >> bit % 8)) {
        const int inner = child(node, bit, start);
        if (inner < 0) return -1;
        stop = walk(inner, stop, end);
      }
    return stop;
  }

  std::int64_t compound(int node, std::int64_t start, std::int64_t end) {
    const std::int64_t flags_stop = flags(node, start, end, t_.nodes[node].size);
    std::int64_t stop = flags_stop;
    for (std::int64_t byte = start; stop >= 0 && byte < flags_stop; ++byte)
      for (unsigned octet = data_[byte] & 0xFEu; octet && stop >= 0;) {
        const int bit = __builtin_clz(octet) - 24;
        octet &= ~(0x80u >> bit);
        const int inner = child(node, int(7 * (byte - start)) + bit, start);
        stop = inner < 0 ? -1 : walk(inner, stop, end);
      }
    return stop;
  }

  std::int64_t random(int node, std::int64_t start, std::int64_t end) {
    const Node& root = t_.nodes[root_];
    std::int64_t position = within(node, start, start + 1, end);
    if (position < 0) return -1;
    for (int left = data_[start]; left; --left) {
      const std::int64_t at = position;
      if (within(node, at, at + 1, end) < 0) return -1;
      const int frn = data_[at];
      const int inner = frn > 0 && frn <= root.count ? t_.index[root.first + frn - 1] : -1;
      if (inner < 0 || t_.nodes[inner].kind == kRandom) return fails(kRandomUnknown, at, node, frn);
      position = walk(inner, at + 1, end);
      if (position < 0) return -1;
    }
    return position;
  }

  const std::uint8_t* data_;
  const Tables& t_;
  const bool strict_;
  Sink& sink_;
  int root_ = 0, longest_ = 0;
  bool source_ = false;

  template <class>
  friend class Walker;
};

}  // namespace saltus::asterix
