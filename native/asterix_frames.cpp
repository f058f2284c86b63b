#include "asterix_frames.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace saltus::frames {
namespace {

constexpr Size kHeader = 3;  // bytes of category and length
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
enum class Outcome { kFrame, kShort, kBad };

struct Frame {
  std::vector<std::pair<Size, Size>> blocks;  // (offset, length)
  Size stop = 0;
  double clock = kNaN;
  int channel = -1;
};

Size big(const Byte* data, Size at) { return Size(data[at]) << 8 | data[at + 1]; }

unsigned crc(const Byte* data, Size start, Size stop, unsigned sum) {
  for (Size k = start; k < stop; ++k) {
    sum ^= data[k];
    for (int bit = 0; bit < 8; ++bit) sum = sum >> 1 ^ (sum & 1 ? 0x8408u : 0u);
  }
  return sum;
}

// Blocks that fill these bytes exactly; none where they do not.
void chain(const Byte* data, Size start, Size stop, std::vector<std::pair<Size, Size>>& blocks) {
  while (start < stop) {
    const Size size = start + kHeader <= stop ? big(data, start + 1) : 0;
    if (size <= kHeader || start + size > stop) return blocks.clear();
    blocks.emplace_back(start, size);
    start += size;
  }
}

Outcome checked(const Byte* data, Size position, Size stop, const Container& c, const Known& known, Frame& found) {
  unsigned sum = crc(data, position, std::min(position + c.header, stop), 0xFFFF);
  Size at = position + c.header;
  while (at + kHeader + c.trailer <= stop) {
    const Size size = big(data, at + 1);
    if (size <= kHeader || !known[data[at]]) return Outcome::kBad;
    if (at + size + c.trailer > stop) return Outcome::kShort;
    found.blocks.emplace_back(at, size);
    sum = crc(data, at, at + size, sum);
    at += size;
    if ((sum ^ 0xFFFFu) == (data[at] | unsigned(data[at + 1]) << 8)) {
      found.stop = at + c.trailer;
      return Outcome::kFrame;
    }
    if (at - position > 0xFFFF) return Outcome::kBad;
  }
  return Outcome::kShort;
}

double clock_of(const Byte* data, Size position, Size end, const Container& c) {
  if (c.clock_at < 0) return kNaN;
  const Size at = c.clock_at < c.header ? position + c.clock_at : end + c.clock_at - c.header;
  std::uint64_t value = 0;
  for (Size k = 0; k < c.clock_bytes; ++k)
    value = value << 8 | data[at + (c.clock_little ? c.clock_bytes - 1 - k : k)];
  return double(value) * c.clock_step;
}

Outcome measure(const Byte* data, Size position, Size stop, const Container& c, const Known& known, Frame& found) {
  found.blocks.clear();
  while (position < stop && data[position] == c.idle) ++position;
  if (position == stop && c.idle >= 0) return Outcome::kShort;
  const Size seen = std::min<Size>(Size(c.opening.size()), stop - position);
  if (!std::equal(c.opening.begin(), c.opening.begin() + seen, data + position,
                  [](char a, Byte b) { return Byte(a) == b; }))
    return Outcome::kBad;
  found.clock = kNaN, found.channel = -1;
  if (c.checked) return checked(data, position, stop, c, known, found);
  const Size first = position + c.header;
  if (first + (c.length_at < 0 ? kHeader : 0) > stop) return Outcome::kShort;
  Size size;
  if (c.length_at < 0) {
    size = big(data, first + 1);
    if (!known[data[first]]) return Outcome::kBad;
  } else {
    const Size at = position + c.length_at;
    size = c.little ? data[at] | Size(data[at + 1]) << 8 : big(data, at);
    if (c.whole) size -= c.header + c.trailer;
  }
  if (size <= kHeader) return Outcome::kBad;
  const Size end = first + size;
  if (end + c.trailer > stop) return Outcome::kShort;
  if (c.fill >= 0)
    for (Size k = end; k < end + c.trailer; ++k)
      if (data[k] != c.fill) return Outcome::kBad;
  chain(data, first, end, found.blocks);
  if (found.blocks.empty() && c.fill < 0) return Outcome::kBad;
  found.stop = end + c.trailer;
  found.clock = clock_of(data, position, end, c);
  if (c.channel_at >= 0) found.channel = int(big(data, position + c.channel_at));
  return Outcome::kFrame;
}

}  // namespace

Scan scan(const Byte* data, Size start, Size stop, const Container& container, const Known& known) {
  Scan out;
  Frame found;
  Blocks& b = out.blocks;
  Size position = start;
  while (position < stop) {
    const Outcome outcome = measure(data, position, stop, container, known, found);
    if (outcome != Outcome::kFrame) {
      out.broken = outcome == Outcome::kBad;
      break;
    }
    for (const auto& [at, size] : found.blocks) {
      b.offset.push_back(at), b.length.push_back(std::int32_t(size)), b.frame.push_back(position);
      b.category.push_back(data[at]), b.clock.push_back(found.clock), b.channel.push_back(found.channel);
    }
    if (found.blocks.empty()) {
      if (out.foreign++ == 0) out.foreign_at = position;
    }
    ++out.frames;
    position = found.stop;
  }
  out.position = position;
  return out;
}

bool holds(const Byte* data, Size start, Size stop, const Container& container, const Known& known, int count) {
  Frame found;
  Size position = start;
  for (int k = 0; k < count; ++k) {
    if (measure(data, position, stop, container, known, found) != Outcome::kFrame || found.blocks.empty()) return false;
    position = found.stop;
    if (position == stop) return true;
  }
  return true;
}

Size find(const Byte* data, Size start, Size last, Size stop, const Container& container, const Known& known,
          int count) {
  for (Size position = start; position <= last && position < stop; ++position)
    if (holds(data, position, stop, container, known, count)) return position;
  return -1;
}

// ---- packet captures

namespace {

constexpr Size kLeast = 14, kMost = 1 << 18, kLargest = 1 << 17;
constexpr std::size_t kWaiting = 64;
constexpr Byte kPcapng[4] = {0x0A, 0x0D, 0x0D, 0x0A};
enum Kind { kLink, kEthertype, kLength, kProtocol, kPort, kBroken, kCut, kTorn, kMissing };

std::uint32_t word(const Byte* p, bool big_endian) {
  return big_endian ? std::uint32_t(p[0]) << 24 | std::uint32_t(p[1]) << 16 | std::uint32_t(p[2]) << 8 | p[3]
                    : std::uint32_t(p[3]) << 24 | std::uint32_t(p[2]) << 16 | std::uint32_t(p[1]) << 8 | p[0];
}

int half(const Byte* p, bool big_endian) { return big_endian ? p[0] << 8 | p[1] : p[1] << 8 | p[0]; }

bool is_pcapng(const Byte* p) { return std::equal(kPcapng, kPcapng + 4, p); }

// Byte order and ticks of a classic capture's magic number; ticks 0 when it is none.
std::pair<bool, double> classic_magic(const Byte* p) {
  const std::uint32_t magic = word(p, true);
  if (magic == 0xA1B2C3D4u) return {true, 1e6};
  if (magic == 0xD4C3B2A1u) return {false, 1e6};
  if (magic == 0xA1B23C4Du) return {true, 1e9};
  if (magic == 0x4D3CB2A1u) return {false, 1e9};
  return {false, 0.0};
}

int ethertype(const Byte* data, Size at, Size end) { return at + 2 <= end ? int(big(data, at)) : 0; }

// Where the IP header is; else -1 and what the frame carries.
Size network(const Byte* data, Size start, Size end, int link, int& kind, int& number) {
  Size at = start;
  if (link == 12 || link == 14 || link == 101 || link == 228 || link == 229) return start;
  if (link == 0 || link == 108) return start + 4;
  if (link == 1) at = start + 12;
  else if (link == 113) at = start + 14;
  else if (link != 276) return kind = kLink, number = link, -1;
  int type = ethertype(data, at, end);
  if (link == 276) at = start + 18;
  while (type == 0x8100 || type == 0x88A8 || type == 0x9100) type = ethertype(data, at += 4, end);
  if (type == 0x0800 || type == 0x86DD) return at + 2;
  kind = type < 0x0600 ? kLength : kEthertype, number = type < 0x0600 ? 0 : type;
  return -1;
}

std::string text(const Byte* data, Size start, Size stop) {
  return {reinterpret_cast<const char*>(data) + start, std::size_t(std::max<Size>(0, stop - start))};
}

}  // namespace

Size Capture::begin(const Byte* head, Size size) {
  interfaces_.clear();
  const auto [big_endian, ticks] = size >= 4 ? classic_magic(head) : std::pair{false, 0.0};
  classic_ = ticks > 0 && size >= 24;
  if (!classic_) return 0;
  big_ = big_endian, ticks_ = ticks, link_ = int(word(head + 20, big_) & 0xFFFF);
  return 24;
}

Size Capture::record(const Byte* data, Size position, Size stop) {
  const Size left = stop - position;
  const Byte* p = data + position;
  if (left < 4) return 0;
  if (classic_) {
    if (classic_magic(p).second > 0 || is_pcapng(p)) return -1;
    if (left < 16) return 0;
    const Size size = word(p + 8, big_);
    if (size < kLeast || size > kMost || double(word(p + 4, big_)) >= ticks_) return -1;
    return 16 + size > left ? 0 : 16 + size;
  }
  if (left < 12) return 0;
  if (is_pcapng(p)) big_ = word(p + 8, true) == 0x1A2B3C4Du;
  const Size size = word(p + 4, big_);
  if (size < 12 || size % 4 || size > 4 * kMost) return -1;
  if (size > left) return 0;
  return Size(word(p + size - 4, big_)) == size ? size : -1;
}

Capture::Taken Capture::scan(const Byte* data, Size start, Size stop, Size base) {
  Taken out;
  base_ = base, stop_ = stop;
  Size position = start;
  while (position < stop) {
    const Size size = record(data, position, stop);
    if (size <= 0) {
      out.broken = size < 0;
      break;
    }
    frame(out, data, position, size);
    out.last = position;
    position += size;
  }
  out.position = position;
  return out;
}

void Capture::frame(Taken& out, const Byte* data, Size position, Size size) {
  const Byte* p = data + position;
  const Size end = position + size;
  if (classic_) {
    const double clock = double(word(p, big_)) + double(word(p + 4, big_)) / ticks_;
    return packet(out, data, position + 16, end, link_, clock, size - 16 >= Size(word(p + 12, big_)));
  }
  const std::uint32_t kind = word(p, big_);
  const Size body = position + 8, stop = end - 4;
  if (is_pcapng(p)) {
    interfaces_.clear();
  } else if (kind == 1 && stop - body >= 8) {
    Interface found{half(data + body, big_), 1e6, 0.0};
    for (Size at = body + 8; at + 4 <= stop;) {
      const int code = half(data + at, big_), length = half(data + at + 2, big_);
      const Size value = at + 4, there = std::min<Size>(length, stop - value);
      if (code == 9 && there == 1)
        found.ticks = data[value] & 0x80 ? std::ldexp(1.0, data[value] & 0x7F) : std::pow(10.0, data[value]);
      if (code == 14 && there == 8) {
        const std::uint64_t low = word(data + value + (big_ ? 4 : 0), big_), high = word(data + value + (big_ ? 0 : 4), big_);
        found.shift = double(std::int64_t(high << 32 | low));
      }
      if (code == 0) break;
      at += 4 + (length + 3) / 4 * 4;
    }
    interfaces_.push_back(found);
  } else if (kind == 6 && stop - body >= 20) {
    const std::uint32_t number = word(data + body, big_);
    if (number >= interfaces_.size()) return;
    const Interface& from = interfaces_[number];
    const std::uint64_t ticks = std::uint64_t(word(data + body + 4, big_)) << 32 | word(data + body + 8, big_);
    const Size last = std::min(body + 20 + Size(word(data + body + 12, big_)), stop);
    packet(out, data, body + 20, last, from.link, double(ticks) / from.ticks + from.shift,
           last - body - 20 >= Size(word(data + body + 16, big_)));
  } else if (kind == 3 && stop - body >= 4 && !interfaces_.empty()) {
    const Size original = word(data + body, big_), last = std::min(body + 4 + original, stop);
    packet(out, data, body + 4, last, interfaces_[0].link, kNaN, last - body - 4 >= original);
  }
}

void Capture::packet(Taken& out, const Byte* data, Size first, Size end, int link, double clock, bool whole) {
  int kind = 0, number = 0;
  const Size ip = network(data, first, end, link, kind, number);
  if (ip < 0) return pass(kind, number, base_ + first, 1);
  const int version = ip < end ? data[ip] >> 4 : 0;
  if (version == 4) return ipv4(out, data, ip, end, clock, whole);
  if (version == 6) return ipv6(out, data, ip, end, clock, whole);
  pass(kBroken, 0, base_ + first, 1);
}

void Capture::ipv4(Taken& out, const Byte* data, Size ip, Size end, double clock, bool whole) {
  const Size header = (data[ip] & 15) * 4;
  if (header < 20 || ip + header > end) return pass(kBroken, 0, base_ + ip, 1);
  const Size total = big(data, ip + 2), stop = total >= header ? std::min(end, ip + total) : end;
  const Size flags = big(data, ip + 6);
  const int protocol = data[ip + 9];
  const std::string addresses = text(data, ip + 12, ip + 20);
  if (flags & 0x3FFF) {
    const std::string key = "4" + addresses + text(data, ip + 4, ip + 6) + char(protocol);
    fragment(out, data, (flags & 0x1FFF) * 8, ip + header, stop, !(flags & 0x2000), key, addresses, protocol, clock);
  } else if (protocol != 17) {
    pass(kProtocol, protocol, base_ + ip, 1);
  } else {
    udp(out, data, ip + header, stop, addresses, {0, 0, clock, 0}, whole);
  }
}

void Capture::ipv6(Taken& out, const Byte* data, Size ip, Size end, double clock, bool whole) {
  if (ip + 40 > end) return pass(kBroken, 0, base_ + ip, 1);
  const Size size = big(data, ip + 4), stop = size ? std::min(end, ip + 40 + size) : end;
  const std::string addresses = text(data, ip + 8, ip + 40);
  int protocol = data[ip + 6];
  Size at = ip + 40;
  while (at + 8 <= stop && (protocol == 0 || protocol == 43 || protocol == 60 || protocol == 51)) {
    const Size step = protocol == 51 ? (data[at + 1] + 2) * 4 : (data[at + 1] + 1) * 8;
    protocol = data[at], at += step;
  }
  if (protocol == 44 && at + 8 <= stop) {
    const Size place = big(data, at + 2);
    if (place & 0xFFF9) {
      const std::string key = "6" + addresses + text(data, at + 4, at + 8);
      return fragment(out, data, place & 0xFFF8, at + 8, stop, !(place & 1), key, addresses, data[at], clock);
    }
    protocol = data[at], at += 8;
  }
  if (protocol != 17) return pass(kProtocol, protocol, base_ + ip, 1);
  udp(out, data, at, stop, addresses, {0, 0, clock, 0}, whole);
}

void Capture::fragment(Taken& out, const Byte* data, Size place, Size start, Size stop, bool last,
                       const std::string& key, const std::string& addresses, int protocol, double clock) {
  if (protocol != 17) return pass(kProtocol, protocol, base_ + start, 1);
  // The datagram last added to stands last: the first is the one waited for longest.
  const auto known = std::find_if(waiting_.begin(), waiting_.end(), [&](const Waiting& w) { return w.key == key; });
  Waiting mine{key, {}, false, 0};
  if (known != waiting_.end()) {
    mine = std::move(*known);
    waiting_.erase(known);
  }
  std::string& part = mine.parts[place];
  mine.bytes -= Size(part.size());
  part = text(data, start, stop);
  mine.bytes += Size(part.size());
  mine.ended |= last;
  if (mine.bytes > kLargest) return pass(kBroken, 0, base_ + start, mine.count());
  std::string joined;
  bool complete = mine.ended;
  for (const auto& [at, bytes] : mine.parts) {
    if (at > Size(joined.size())) complete = false;
    if (!complete) break;
    const std::size_t skip = joined.size() - std::size_t(at);
    if (skip < bytes.size()) joined.append(bytes, skip);
  }
  if (complete) {
    const Size shift = stop_ + Size(out.extra.size());
    out.extra += joined;
    const Where where{shift, base_ + start, clock, 0};
    return udp(out, reinterpret_cast<const Byte*>(joined.data()), 0, Size(joined.size()), addresses, where, true);
  }
  waiting_.push_back(std::move(mine));
  if (waiting_.size() > kWaiting) {
    pass(kMissing, 0, base_ + start, waiting_.front().count());
    waiting_.erase(waiting_.begin());
  }
}

void Capture::udp(Taken& out, const Byte* data, Size start, Size stop, const std::string& addresses, Where where,
                  bool whole) {
  if (start + 8 > stop) return pass(whole ? kBroken : kCut, 0, where.at ? where.at : base_ + start, 1);
  const Size size = big(data, start + 4), end = size < 8 ? stop : start + size;
  const std::string key = addresses + text(data, start, start + 4);
  if (!where.shift) where.at = base_ + start + 8;
  const auto seen = seen_.find(key);
  where.channel = seen == seen_.end() ? int(channels_.size()) : seen->second;
  if (!payload(out, data, start + 8, std::min(end, stop), where, end > stop)) {
    pass(kPort, int(big(data, start + 2)), where.at, 1);
  } else if (seen == seen_.end()) {
    seen_[key] = where.channel;
    channels_.push_back(key);
  }
}

bool Capture::payload(Taken& out, const Byte* data, Size start, Size stop, const Where& where, bool cut) {
  std::vector<std::pair<Size, Size>> blocks;
  Size position = start;
  while (position + kHeader <= stop) {
    const Size size = big(data, position + 1);
    if (size <= kHeader || position + size > stop) break;
    blocks.emplace_back(position, size);
    position += size;
  }
  bool torn = position < stop;
  if (torn && !cut) {
    for (const Container& container : inside_) {
      const Scan found = frames::scan(data, start, stop, container, known_);
      if (found.position == stop && !found.blocks.offset.empty()) {
        blocks.clear();
        for (std::size_t k = 0; k < found.blocks.offset.size(); ++k)
          blocks.emplace_back(found.blocks.offset[k], found.blocks.length[k]);
        torn = false;
        break;
      }
    }
  }
  if (torn && !(start < stop && known_[data[start]] && (!blocks.empty() || cut))) return false;
  if (blocks.empty() && !torn) return false;
  for (const auto& [offset, size] : blocks) add(out, data, offset, size, where, false);
  if (torn) {
    pass(cut ? kCut : kTorn, 0, where.at, 1);
    if (cut && position + kHeader < stop && known_[data[position]]) add(out, data, position, stop - position, where, true);
  }
  return true;
}

void Capture::add(Taken& out, const Byte* data, Size offset, Size size, const Where& where, bool cut) {
  Blocks& b = out.blocks;
  b.offset.push_back(offset + where.shift), b.length.push_back(std::int32_t(size)), b.category.push_back(data[offset]);
  b.clock.push_back(where.clock), b.channel.push_back(where.channel), b.cut.push_back(cut);
  b.at.push_back(where.shift ? where.at : base_ + offset);
}

void Capture::pass(int kind, int number, Size at, Size count) {
  const auto entry = passed_.try_emplace({kind, number}, 0, at).first;
  entry->second.first += count;
}

void Capture::finish() {
  for (const Waiting& waiting : waiting_) pass(kMissing, 0, -1, waiting.count());
  waiting_.clear();
}

}  // namespace saltus::frames
