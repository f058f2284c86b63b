// Tables of saltus.asterix.program, and bits in bytes. Free of the interpreter.
#pragma once

#include <cstdint>
#include <cstring>

namespace saltus::asterix {

// As in saltus/asterix/layout.py and program.py.
enum Kind : std::int32_t { kFixed, kExtended, kRepeated, kExplicit, kCompound, kExpansion, kRandom };
enum Form : std::int32_t { kFloat, kInteger, kIcao, kAscii, kBytes, kSpan };
enum Code : std::int64_t {
  kNone,
  kEndless,
  kLong,
  kUndefined,
  kShort,
  kBeyond,
  kEmpty,
  kRandomUnknown,
  kNoSource,
  kNoProfile,
  kContent
};

struct Node {
  std::int32_t kind, size, first, count, first_slot, slots;
};

struct Slot {
  std::int32_t form, offset, size, is_signed, output, first_guard, guards;
};

struct Guard {
  std::int32_t offset, size, value;
};

struct Scale {
  double step, origin;
};

struct Tables {
  const Node* nodes;
  const std::int32_t* index;
  const std::int32_t* roots;
  int n_roots;
  const std::int32_t* select;  // node, offset, size; null = one profile
  const std::int32_t* profiles;  // pairs of value and profile
  int n_profiles;
  const Slot* slots;
  const Scale* scale;
  const Guard* guards;
  int required;  // node that every record must hold, -1 = none
};

// Up to 64 bits, `offset` bits from `at`, left-aligned; all of them lie before `end`.
inline std::uint64_t aligned_bits(const std::uint8_t* at, const std::uint8_t* end, int offset, int size) {
  at += offset >> 3;
  const int shift = offset & 7;
  std::uint64_t word = 0;
  if (end - at >= 8) {
    std::memcpy(&word, at, 8);
    word = __builtin_bswap64(word);
  } else {
    for (std::ptrdiff_t i = 0; i < end - at; ++i) word |= std::uint64_t(at[i]) << (56 - 8 * i);
  }
  word <<= shift;
  if (size + shift > 64) word |= std::uint64_t(at[8]) >> (8 - shift);
  return word;
}

inline std::uint64_t bits(const std::uint8_t* at, const std::uint8_t* end, int offset, int size) {
  return aligned_bits(at, end, offset, size) >> (64 - size);
}

inline std::int64_t signed_bits(const std::uint8_t* at, const std::uint8_t* end, int offset, int size) {
  return std::int64_t(aligned_bits(at, end, offset, size)) >> (64 - size);
}

}  // namespace saltus::asterix
