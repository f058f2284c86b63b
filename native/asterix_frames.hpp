// Frames of a recording to ASTERIX data blocks: compiled twins of saltus.framing.scan and saltus.framing.capture.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <map>
#include <string>
#include <utility>
#include <vector>

namespace saltus::frames {

using Size = std::int64_t;
using Byte = std::uint8_t;

// How the frames of a container are built; saltus.framing.containers.Container says what each means.
struct Container {
  Size header, trailer, length_at;
  bool little, whole, checked;
  int fill, idle;
  std::string opening;
  Size clock_at, clock_bytes;
  double clock_step;
  bool clock_little;
  Size channel_at;
};

using Known = std::array<bool, 256>;

struct Blocks {
  std::vector<Size> offset, frame, at;
  std::vector<std::int32_t> length, channel;
  std::vector<Byte> category, cut;
  std::vector<double> clock;
};

struct Scan {
  Blocks blocks;
  Size position, frames = 0, foreign = 0, foreign_at = -1;
  bool broken = false;
};

Scan scan(const Byte* data, Size start, Size stop, const Container& container, const Known& known);
bool holds(const Byte* data, Size start, Size stop, const Container& container, const Known& known, int count);
Size find(const Byte* data, Size start, Size last, Size stop, const Container& container, const Known& known,
          int count);

// Takes packets apart; keeps what lasts from one piece of a capture to the next.
class Capture {
 public:
  struct Taken {
    Blocks blocks;
    std::string extra;
    Size position, last = -1;
    bool broken = false;
  };
  using Passed = std::map<std::pair<int, int>, std::pair<Size, Size>>;

  Capture(std::vector<Container> inside, const Known& known) : inside_(std::move(inside)), known_(known) {}
  Size begin(const Byte* head, Size size);
  Taken scan(const Byte* data, Size start, Size stop, Size base);
  Size record(const Byte* data, Size position, Size stop);
  void finish();
  const Passed& passed() const { return passed_; }
  const std::vector<std::string>& channels() const { return channels_; }

 private:
  struct Interface {
    int link;
    double ticks, shift;
  };
  struct Where {
    Size shift, at;
    double clock;
    int channel;
  };
  struct Waiting {
    std::string key;
    std::map<Size, std::string> parts;
    bool ended = false;
    Size bytes = 0;
    Size count() const { return Size(parts.size()) + ended; }
  };

  void frame(Taken& out, const Byte* data, Size position, Size size);
  void packet(Taken& out, const Byte* data, Size first, Size end, int link, double clock, bool whole);
  void ipv4(Taken& out, const Byte* data, Size ip, Size end, double clock, bool whole);
  void ipv6(Taken& out, const Byte* data, Size ip, Size end, double clock, bool whole);
  void fragment(Taken& out, const Byte* data, Size place, Size start, Size stop, bool last, const std::string& key,
                const std::string& addresses, int protocol, double clock);
  void udp(Taken& out, const Byte* data, Size start, Size stop, const std::string& addresses, Where where, bool whole);
  bool payload(Taken& out, const Byte* data, Size start, Size stop, const Where& where, bool cut);
  void add(Taken& out, const Byte* data, Size offset, Size size, const Where& where, bool cut);
  void pass(int kind, int number, Size at, Size count);

  std::vector<Container> inside_;
  Known known_;
  bool classic_ = true, big_ = false;
  double ticks_ = 1e6;
  int link_ = 1;
  Size base_ = 0, stop_ = 0;
  std::vector<Interface> interfaces_;
  std::vector<Waiting> waiting_;
  std::map<std::string, int> seen_;
  std::vector<std::string> channels_;
  Passed passed_;
};

}  // namespace saltus::frames
