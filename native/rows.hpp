// Between rows in memory and lanes in registers, through W x W transposes.
#pragma once

#include "kernel.hpp"
#include "lanes.hpp"

namespace saltus::SALTUS_NS {

using Size = std::ptrdiff_t;

// Hands out pieces of a workspace; without memory it only counts them.
struct Arena {
  V* base = nullptr;
  std::size_t used = 0;
  V* take(std::size_t count) {
    V* piece = base ? base + used : nullptr;
    used += count;
    return piece;
  }
  int* take_ints(std::size_t count) { return reinterpret_cast<int*>(take((count * sizeof(int)) / sizeof(V) + 1)); }
};

// out[i] lane l = rows[l][i], i < count.
inline void load_lanes(const double* const (&rows)[W], int count, V* out) {
  int i = 0;
  for (; i + W <= count; i += W) {
    V r[W];
#pragma GCC unroll 8
    for (int l = 0; l < W; ++l) r[l] = load(rows[l] + i);
    transpose(r);
#pragma GCC unroll 8
    for (int l = 0; l < W; ++l) out[i + l] = r[l];
  }
  for (; i < count; ++i)
    for (int l = 0; l < W; ++l) out[i][l] = rows[l][i];
}

// out[l * stride + i] = in[index[i]] lane l, i < count, l < lanes.
inline void store_lanes(const V* in, const int* index, int count, double* out, Size stride, int lanes) {
  int i = 0;
  for (; i + W <= count; i += W) {
    V r[W];
#pragma GCC unroll 8
    for (int l = 0; l < W; ++l) r[l] = in[index[i + l]];
    transpose(r);
#pragma GCC unroll 8
    for (int l = 0; l < W; ++l)
      if (l < lanes) store(out + l * stride + i, r[l]);
  }
  for (; i < count; ++i)
    for (int l = 0; l < lanes; ++l) out[l * stride + i] = in[index[i]][l];
}

inline const double* address(const Model& model, Size track, Size step) {
  return model.data + (model.rows ? model.rows[track] : track) * model.row + step * model.time;
}

// The rows of `model` for the tracks from `first` on, one per lane; the last track fills the lanes beyond it.
inline void load_model(const Model& model, Size first, Size n_tracks, Size step, V* out) {
  if (!model.data) return;
  const int count = model.distinct * model.core;
  if (!model.row) {
    const double* row = address(model, 0, step);
    for (int i = 0; i < count; ++i) out[i] = row[i] - V{};
    return;
  }
  const double* rows[W];
  bool one = true;
  for (int l = 0; l < W; ++l) {
    rows[l] = address(model, first + l < n_tracks ? first + l : n_tracks - 1, step);
    // A stream per track is more than the hardware follows: ask for the row after the next.
    if (model.time)
      for (int i = 0; i < count; i += 8) __builtin_prefetch(rows[l] + 2 * model.time + i);
    one = one && rows[l] == rows[0];
  }
  if (one) {  // particles lie sorted by mode
    for (int i = 0; i < count; ++i) out[i] = splat(rows[0][i]);
    return;
  }
  load_lanes(rows, count, out);
}

// Part of a variance by which a pivot may be negative before the matrix is no covariance.
inline constexpr double kIndefinite = 1e-8;
// Part of it below which a pivot is not divided by, or rounding would grow to that. Twins of filters/align.py.
inline constexpr double kDead = 1e-6;

// Lanes in which a full matrix of order n is no covariance, by its pivots; `rest` holds n^2 numbers.
inline I indefinite(const V* a, int n, V* rest) {
  I bad{};
  for (int i = 0; i < n * n; ++i) rest[i] = a[i];
  for (int j = 0; j < n; ++j) {
    const V pivot = rest[j * n + j], least = kIndefinite * a[j * n + j];
    const I dead = pivot <= kDead * a[j * n + j];
    bad |= (pivot < -least) | (a[j * n + j] < 0.0);
    const V one_over = select(dead, V{}, reciprocal(pivot));
    for (int i = j + 1; i < n; ++i) {
      bad |= a[i * n + j] != a[j * n + i];
      const V column = rest[i * n + j], share = column * one_over;
      const V other = maximum(rest[i * n + i], V{}) + kIndefinite * a[i * n + i];
      bad |= dead & (column * column > 4.0 * (maximum(pivot, V{}) + least) * other);
      for (int k = j + 1; k <= i; ++k) rest[i * n + k] -= share * rest[k * n + j];
    }
  }
  return bad;
}

// Lanes in which a loaded array holds NaN or inf or, for matrices of order n > 0, is no covariance.
inline I doubtful(const Model& model, const V* loaded, int n, V* heap) {
  I bad{};
  const int count = model.data ? model.distinct * model.core : 0;
  for (int i = 0; i < count; ++i) bad |= ~finite(loaded[i]);
  for (const V* a = loaded; n > 0 && a < loaded + count; a += n * n) bad |= indefinite(a, n, heap);
  return bad;
}

// The same of all rows of a model, before anything is done with it.
inline bool doubtful_rows(const Model& model, Size rows, int n, V* loaded, V* heap) {
  bool bad = false;
  for (Size first = 0; first < (model.row ? rows : rows > 0); first += W) {
    load_model(model, first, rows, 0, loaded);
    bad = bad || any(doubtful(model, loaded, n, heap));
  }
  return bad;
}

inline std::size_t lanes_of(const Model& model) { return model.data ? model.distinct * model.core : 0; }

// Where element i of a full symmetric matrix lies in a packed one, for `index` of store_lanes.
inline void symmetric_index(int n, int base, int* index) {
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < n; ++j)
      index[i * n + j] = base + (i >= j ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i);
}

}  // namespace saltus::SALTUS_NS
