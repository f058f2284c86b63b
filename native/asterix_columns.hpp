// Takes fields out of the items that a walk meets: the compiled twin of `extract` in saltus/asterix/walk.py.
#pragma once

#include <vector>

#include "asterix.hpp"

namespace saltus::asterix {

// Where a column goes: one place for each record, or a growing list of values and the records they are of.
struct Output {
  void* values = nullptr;
  std::uint8_t* present = nullptr;  // null = repeated
  std::int32_t width = 8;           // bytes of a value
  std::vector<char> many;
  std::vector<std::int64_t> rows;
};

class Columns {
 public:
  static constexpr bool kKeeps = true;

  Columns(const std::uint8_t* data, const Tables& tables, std::vector<Output>& outputs)
      : data_(data), t_(tables), outputs_(outputs) {}

  std::int64_t row = 0;

  void whole(int node, std::int64_t start, std::int64_t stop) {
    const Node& n = t_.nodes[node];
    for (int k = n.first_slot; k < n.first_slot + n.slots; ++k)
      if (t_.slots[k].form == kSpan) {
        Output& out = outputs_[t_.slots[k].output];
        std::int64_t* pair = static_cast<std::int64_t*>(out.values) + 2 * row;
        pair[0] = start, pair[1] = stop;
        out.present[row] = 1;
      }
  }

  void one(int node, std::int64_t start, std::int64_t stop) {
    const Node& n = t_.nodes[node];
    const std::uint8_t *at = data_ + start, *end = data_ + stop;
    const std::int64_t given = 8 * (stop - start);
    for (int k = n.first_slot; k < n.first_slot + n.slots; ++k) {
      const Slot& slot = t_.slots[k];
      if (slot.form == kSpan || slot.offset + slot.size > given || !holds(slot, at, end, given)) continue;
      Output& out = outputs_[slot.output];
      char* place = next(out);
      switch (slot.form) {
        case kFloat: {
          const Scale& scale = t_.scale[k];
          const double value = slot.is_signed ? double(signed_bits(at, end, slot.offset, slot.size))
                                              : double(bits(at, end, slot.offset, slot.size));
          put(place, value * scale.step + scale.origin);
          break;
        }
        case kInteger:
          put(place, slot.is_signed ? signed_bits(at, end, slot.offset, slot.size)
                                    : std::int64_t(bits(at, end, slot.offset, slot.size)));
          break;
        case kBytes:
          for (int i = 0; i < out.width; ++i) place[i] = char(bits(at, end, slot.offset + 8 * i, 8));
          break;
        default:
          text(place, out.width, slot, at, end);
      }
    }
  }

 private:
  bool holds(const Slot& slot, const std::uint8_t* at, const std::uint8_t* end, std::int64_t given) const {
    for (int g = slot.first_guard; g < slot.first_guard + slot.guards; ++g) {
      const Guard& guard = t_.guards[g];
      if (guard.offset + guard.size > given ||
          bits(at, end, guard.offset, guard.size) != std::uint64_t(guard.value))
        return false;
    }
    return true;
  }

  char* next(Output& out) {
    if (out.present) {
      out.present[row] = 1;
      return static_cast<char*>(out.values) + out.width * row;
    }
    out.rows.push_back(row);
    out.many.resize(out.many.size() + out.width);
    return out.many.data() + out.many.size() - out.width;
  }

  template <class T>
  static void put(char* place, T value) {
    std::memcpy(place, &value, sizeof value);
  }

  // A to Z are 1 to 26, blank 32, digits 48 to 57; others stand for nothing. Blanks around the text go.
  static void text(char* place, int width, const Slot& slot, const std::uint8_t* at, const std::uint8_t* end) {
    const int each = slot.form == kIcao ? 6 : 8;
    int length = 0, kept = 0;
    for (int i = 0; i < width; ++i) {
      int code = int(bits(at, end, slot.offset + each * i, each));
      if (slot.form == kIcao) code = code >= 1 && code <= 26 ? code + 64 : code == 32 || (code >= 48 && code <= 57) ? code : 0;
      if (code == 0 || (code == 32 && length == 0)) continue;
      place[length++] = char(code);
      if (code != 32) kept = length;
    }
    std::memset(place + kept, 0, std::size_t(width - kept));
  }

  const std::uint8_t* data_;
  const Tables& t_;
  std::vector<Output>& outputs_;
};

}  // namespace saltus::asterix
