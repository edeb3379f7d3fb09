// CUDA on the CPU, for tests: enough of the language that a .cu file compiles as C++ and runs, block after block, with a
// fibre (a stack of its own, switched by hand) for every thread of a block. Blocks are one-dimensional.
//
// A fibre runs until it must wait for the others of its warp (shuffles, votes) or of its block (barriers). What hardware
// leaves open is a choice here: `order` runs blocks, warps and lanes as they are numbered (0), in the opposite order (1),
// or in a new random order every time (any other number is its seed), so that code whose result depends on it shows it.
// A barrier that not all threads reach is an error, not a hang. Not covered: memory shared between blocks that run at
// the same time, and the order in which the warps of real hardware interleave.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <memory>
#include <stdexcept>
#include <utility>
#include <vector>
#if !defined(__x86_64__)
#include <ucontext.h>
#endif
#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/asan_interface.h>
#endif

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __shared__ static  // one block runs at a time

struct dim3 {
  unsigned x = 1, y = 1, z = 1;
};

namespace shim {

constexpr int WARP = 32;
constexpr size_t STACK = 64 << 10;

// ---------------------------------------------------------------------------------------------------- fibres

#if defined(__x86_64__)
// Saves what a call must preserve on the stack that is left, and takes it from the stack that is entered.
extern "C" void d2_shim_switch(void** from, void* to);
asm(R"(
.text
.globl d2_shim_switch
.type d2_shim_switch, @function
d2_shim_switch:
  push %rbp
  push %rbx
  push %r12
  push %r13
  push %r14
  push %r15
  mov %rsp, (%rdi)
  mov %rsi, %rsp
  pop %r15
  pop %r14
  pop %r13
  pop %r12
  pop %rbx
  pop %rbp
  ret
)");

class Context {
 public:
  void start(char* stack, void (*entry)()) {
    // After the six registers and the return into `entry`, the stack must be as after a call: 8 below a multiple of 16.
    void** top = reinterpret_cast<void**>((reinterpret_cast<uintptr_t>(stack) + STACK) & ~uintptr_t(15)) - 1;
    *--top = reinterpret_cast<void*>(entry);
    top -= 6;
    std::memset(top, 0, 6 * sizeof(void*));
    pointer_ = top;
  }
  static void change(Context& from, Context& to) { d2_shim_switch(&from.pointer_, to.pointer_); }

 private:
  void* pointer_ = nullptr;
};
#else
class Context {
 public:
  void start(char* stack, void (*entry)()) {
    getcontext(&context_);
    context_.uc_stack.ss_sp = stack, context_.uc_stack.ss_size = STACK, context_.uc_link = nullptr;
    makecontext(&context_, entry, 0);
  }
  static void change(Context& from, Context& to) { swapcontext(&from.context_, &to.context_); }

 private:
  ucontext_t context_;
};
#endif

// ---------------------------------------------------------------------------------------------------- a block

// Threads that wait for each other. Values are kept twice: a fast thread may deposit the next one while a slow one has
// still to read.
struct Meeting {
  int members = 0, arrived = 0;
  unsigned generation = 0;
  uint64_t sum = 0, sums[2] = {0, 0};
  uint64_t deposits[2][WARP];

  void release() {
    sums[generation & 1] = sum;
    sum = arrived = 0;
    generation++;
  }
};

struct Fiber {
  Context context;
  std::unique_ptr<char[]> stack{new char[STACK]};
  bool done = false;
};

// Orders of 0 .. count - 1.
class Order {
 public:
  explicit Order(unsigned kind) : kind_(kind), state_(kind | 1u) {}

  const std::vector<int>& of(int count, std::vector<int>& places) {
    places.resize(count);
    for (int i = 0; i < count; i++) places[i] = kind_ == 1 ? count - 1 - i : i;
    if (kind_ > 1)
      for (int i = count - 1; i > 0; i--) std::swap(places[i], places[draw() % unsigned(i + 1)]);
    return places;
  }

 private:
  unsigned draw() {
    state_ ^= state_ << 13, state_ ^= state_ >> 17, state_ ^= state_ << 5;
    return state_;
  }
  unsigned kind_, state_;
};

struct Block {
  std::vector<Fiber> fibers;
  std::vector<Meeting> warps;
  Meeting all;
  Context scheduler;
  int current = 0;
  dim3 index, grid;
  int threads = 0;
  const std::function<void()>* body = nullptr;

  Meeting& warp() { return warps[current / WARP]; }
};
static Block block;  // of this library: one is compiled per number of channels

inline void leave() { Context::change(block.fibers[block.current].context, block.scheduler); }

// Waits for the others of the meeting; returns which of the two places holds this round's values.
inline unsigned meet(Meeting& meeting, uint64_t value) {
  const unsigned round = meeting.generation;
  meeting.sum += value;
  if (++meeting.arrived == meeting.members) meeting.release();
  while (meeting.generation == round) leave();
  return round & 1;
}

inline void run_fiber() {
  (*block.body)();
  block.fibers[block.current].done = true;
  for (Meeting* meeting : {&block.warp(), &block.all})
    if (--meeting->members > 0 && meeting->arrived == meeting->members) meeting->release();
  leave();
  std::abort();  // a finished fibre is never resumed
}

// One turn of every unfinished fibre of a warp; whether anything came of it.
inline bool run_warp(int warp, Order& order) {
  const unsigned before = block.warps[warp].generation + block.all.generation;
  const int arrived = block.warps[warp].arrived + block.all.arrived, members = block.all.members;
  std::vector<int> lanes;
  for (int lane : order.of(WARP, lanes)) {
    block.current = warp * WARP + lane;
    if (block.current >= int(block.fibers.size()) || block.fibers[block.current].done) continue;
    Context::change(block.scheduler, block.fibers[block.current].context);
  }
  return block.warps[warp].generation + block.all.generation != before || block.all.members != members ||
         block.warps[warp].arrived + block.all.arrived != arrived;
}

inline void run_block(const std::function<void()>& body, dim3 index, int count, dim3 grid, Order& order) {
  const int warps = (count + WARP - 1) / WARP;
  block.fibers.resize(count);
  block.warps.assign(warps, Meeting());
  block.all = Meeting();
  block.index = index, block.threads = count, block.grid = grid, block.body = &body;
  for (int i = 0; i < count; i++) {
    block.fibers[i].done = false;
#if defined(__SANITIZE_ADDRESS__)
    // The fibre that had this stack before never returned, so its variables still count as out of scope.
    __asan_unpoison_memory_region(block.fibers[i].stack.get(), STACK);
#endif
    block.fibers[i].context.start(block.fibers[i].stack.get(), run_fiber);
    block.warps[i / WARP].members++, block.all.members++;
  }
  while (block.all.members > 0) {
    bool progress = false;
    std::vector<int> places;
    for (int warp : order.of(warps, places))
      while (block.all.members > 0 && run_warp(warp, order)) progress = true;
    if (!progress) throw std::runtime_error("threads wait for others that will never come (diverged barrier or shuffle)");
  }
}

template <class Kernel, class... Arguments>
void launch(Kernel kernel, dim3 grid, int threads, unsigned kind, const Arguments&... arguments) {
  const std::function<void()> body = [&] { kernel(arguments...); };
  const unsigned count = grid.x * grid.y * grid.z;
  Order order(kind);
  std::vector<int> places;
  for (int place : order.of(int(count), places)) {
    const unsigned b = unsigned(place);
    run_block(body, {b % grid.x, b / grid.x % grid.y, b / (grid.x * grid.y)}, threads, grid, order);
  }
}

// ---------------------------------------------------------------------------------------------------- warps

inline int lane() { return block.current % WARP; }

// Every thread of the warp deposits a value and sees those of all.
template <class T>
const uint64_t* exchange(T value) {
  static_assert(sizeof(T) <= sizeof(uint64_t));
  Meeting& warp = block.warp();
  uint64_t& place = warp.deposits[warp.generation & 1][lane()];
  place = 0;
  std::memcpy(&place, &value, sizeof(T));
  return warp.deposits[meet(warp, 0)];
}

template <class T>
T from_bits(uint64_t bits) {
  T value;
  std::memcpy(&value, &bits, sizeof(T));
  return value;
}

inline dim3 thread_index() { return {unsigned(block.current), 0, 0}; }

}  // namespace shim

#define threadIdx (shim::thread_index())
#define blockIdx (shim::block.index)
#define blockDim (dim3{unsigned(shim::block.threads)})
#define gridDim (shim::block.grid)

// A barrier's sums are kept in the same two places as a warp's values.
inline int __syncthreads_count(int predicate) {
  return int(shim::block.all.sums[shim::meet(shim::block.all, predicate != 0)]);
}
inline int __syncthreads_or(int predicate) { return __syncthreads_count(predicate) > 0; }
inline void __syncthreads() { __syncthreads_count(0); }

template <class T>
T __shfl_xor_sync(unsigned, T value, int mask) {
  return shim::from_bits<T>(shim::exchange(value)[shim::lane() ^ mask]);
}
// Votes are a sum of different powers of two.
inline unsigned __ballot_sync(unsigned mask, int predicate) {
  shim::Meeting& warp = shim::block.warp();
  return unsigned(warp.sums[shim::meet(warp, uint64_t(predicate != 0) << shim::lane())]) & mask;
}
inline int __any_sync(unsigned mask, int predicate) { return __ballot_sync(mask, predicate) != 0; }
inline int __popc(unsigned value) { return __builtin_popcount(value); }
inline int __ffs(int value) { return __builtin_ffs(value); }
