// Packs raw integers into records: the compiled twin of saltus/asterix/pack.py.
#pragma once

#include <vector>

#include "asterix.hpp"

namespace saltus::asterix {

// Raw integers of a field: one for each record, or those of record k from first[k] to first[k + 1].
struct Input {
  const std::int64_t* values;
  const std::uint8_t* present;  // null = all
  const std::int64_t* first;    // null = dense
};

class Packer {
 public:
  Packer(const Tables& tables, const std::vector<Input>& inputs) : t_(tables), inputs_(inputs) {}

  std::vector<std::uint8_t> bytes;
  std::int64_t overflow = -1;  // record with more repetitions or bytes than their count can say

  // Appends what record `row` holds of a node.
  void put(int node, std::int64_t row) {
    const Node& n = t_.nodes[node];
    switch (n.kind) {
      case kFixed:
        fields(n, row, n.size, 0);
        return;
      case kExtended:
        extended(n, row);
        return;
      case kRepeated:
        repeated(n, row);
        return;
      case kExplicit:
        explicit_length(n, row);
        return;
      default:
        flagged(n, row);
    }
  }

 private:
  struct Given {
    std::int64_t start, count;
  };

  Given given(int output, std::int64_t row) const {
    const Input& in = inputs_[output];
    if (in.first) return {in.first[row], in.first[row + 1] - in.first[row]};
    return {row, !in.present || in.present[row]};
  }

  bool has(int node, std::int64_t row) const {
    const Node& n = t_.nodes[node];
    for (int k = n.first_slot; k < n.first_slot + n.slots; ++k)
      if (given(t_.slots[k].output, row).count) return true;
    if (n.kind != kCompound && n.kind != kExpansion && n.kind != kExplicit) return false;
    for (int k = n.first; k < n.first + n.count; ++k)
      if (t_.index[k] >= 0 && has(t_.index[k], row)) return true;
    return false;
  }

  void set(std::size_t at, int offset, int size, std::uint64_t value) {
    for (int last = offset + size - 1; size > 0;) {
      const int used = last % 8 + 1, take = used < size ? used : size;  // bits of this byte from its lowest one on
      bytes[at + last / 8] |= std::uint8_t((value & ((1u << take) - 1)) << (7 - last % 8));
      value >>= take, size -= take, last -= take;
    }
  }

  void fields(const Node& n, std::int64_t row, std::int64_t size, std::int64_t repetition) {
    const std::size_t at = bytes.size();
    bytes.resize(at + size);
    for (int k = n.first_slot; k < n.first_slot + n.slots; ++k) {
      const Slot& slot = t_.slots[k];
      const Given found = given(slot.output, row);
      if (found.count <= repetition) continue;
      const std::int64_t place = found.start + repetition, *values = inputs_[slot.output].values;
      if (slot.size <= 64) {
        set(at, slot.offset, slot.size, std::uint64_t(values[place]));
      } else {
        for (int i = 0; i < slot.size / 8; ++i)
          set(at, slot.offset + 8 * i, 8, std::uint64_t(values[place * (slot.size / 8) + i]));
      }
    }
  }

  // Parts up to the last with a field that is given.
  void extended(const Node& n, std::int64_t row) {
    int needed = 0;
    for (int k = n.first_slot; k < n.first_slot + n.slots; ++k) {
      const Slot& slot = t_.slots[k];
      if (given(slot.output, row).count && slot.offset + slot.size > needed) needed = slot.offset + slot.size;
    }
    std::int64_t whole = 0;
    for (int k = n.first; k < n.first + n.count; ++k) whole += t_.index[k] < 0 ? -t_.index[k] : t_.index[k];
    const std::size_t at = bytes.size();
    fields(n, row, whole, 0);
    std::size_t stop = at;
    for (int k = n.first; k < n.first + n.count; ++k) {
      stop += t_.index[k] < 0 ? -t_.index[k] : t_.index[k];
      if (8 * std::int64_t(stop - at) >= needed) break;
      bytes[stop - 1] |= 1;
    }
    bytes.resize(stop);
  }

  void repeated(const Node& n, std::int64_t row) {
    const std::int64_t count = given(t_.slots[n.first_slot].output, row).count;
    const int count_bytes = t_.index[n.first];
    if (count_bytes && count >> (8 * count_bytes)) overflow = row;
    for (int k = count_bytes - 1; k >= 0; --k) bytes.push_back(std::uint8_t(count >> (8 * k)));
    for (std::int64_t k = 0; k < count; ++k) {
      fields(n, row, n.size, k);
      if (count_bytes == 0 && k < count - 1) bytes.back() |= 1;
    }
  }

  void explicit_length(const Node& n, std::int64_t row) {
    const std::size_t at = bytes.size();
    bytes.push_back(0);
    if (n.count && has(t_.index[n.first], row)) {
      put(t_.index[n.first], row);
    } else if (n.slots) {
      const int output = t_.slots[n.first_slot].output;
      const Given found = given(output, row);
      for (std::int64_t k = 0; k < found.count; ++k)
        bytes.push_back(std::uint8_t(inputs_[output].values[found.start + k]));
    }
    if (bytes.size() - at > 255) overflow = row;
    bytes[at] = std::uint8_t(bytes.size() - at);
  }

  // Flags and the children they announce: 7 a byte and as many bytes as needed, or 8 in bytes of a fixed number.
  void flagged(const Node& n, std::int64_t row) {
    const bool fixed = n.kind == kExpansion;
    const int each = fixed ? 8 : 7;
    std::uint8_t flags[32] = {};
    int last = 0;
    std::int32_t held[224];
    int n_held = 0;
    for (int k = 0; k < n.count; ++k) {
      const int child = t_.index[n.first + k];
      if (child < 0 || !has(child, row)) continue;
      held[n_held++] = child;
      last = k / each;
      flags[last] |= 0x80 >> k % each;
    }
    if (fixed) last = n.size - 1;
    for (int k = 0; k < last && !fixed; ++k) flags[k] |= 1;
    bytes.insert(bytes.end(), flags, flags + last + 1);
    for (int k = 0; k < n_held; ++k) put(held[k], row);
  }

  const Tables& t_;
  const std::vector<Input>& inputs_;
};

}  // namespace saltus::asterix
