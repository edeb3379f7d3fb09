// Sums of absolute gradients: for every Gaussian, over the pixels it touches, |dL_p/dx| and |dL_p/dy| of its centre on
// the screen, where L_p is the share that pixel p has in the loss (AbsGS, Ye et al. 2024; the input means2D_densify of
// Deformable-3D-Gaussians). The sum that an ordinary backward pass leaves lets gradients of opposite sign cancel.
//
// Fragments are those of the rasterizer (kernels/splat.h), which keeps sums only, so they are walked again here, front
// to back: behind a Gaussian lies what the finished image has and the walk has not yet seen.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace d2 {

constexpr int TILE = 16;

// What one call works on, as absolute.py fills it in. Arrays of Gaussians [M] are sorted front to back.
struct Walk {
  int32_t width, height, channels, count;
  float alpha_min, alpha_max, transmittance_min;
  const float *x, *y, *ux, *uy, *vy;  // centre, pixels; u = ux dx + uy dy, v = vy dy, alpha = o exp(-(u^2 + v^2) / 2)
  const float *opacity, *reach_x, *reach_y;
  const float* values;    // [M, C]
  const float* image;   // [H, W, C] finished, what shines through included
  const float* gradient;  // [H, W, C] dL/d(image)
  float* sums;            // [M, 2] in and out
};

// dL/d(alpha) of fragment after fragment of one pixel.
class Pixel {
 public:
  Pixel(const Walk& walk, int column, int row)
      : walk_(walk), column_(column + 0.5f), row_(row + 0.5f) {
    const int64_t first = (int64_t(row) * walk.width + column) * walk.channels;
    gradient_ = walk.gradient + first;
    for (int c = 0; c < walk.channels; c++) behind_ += double(gradient_[c]) * walk.image[first + c];
  }

  // False once the pixel is finished.
  bool add(int i) {
    const float dx = column_ - walk_.x[i], dy = row_ - walk_.y[i];
    const float u = walk_.ux[i] * dx + walk_.uy[i] * dy, v = walk_.vy[i] * dy;
    const float unclamped = walk_.opacity[i] * std::exp(-0.5f * (u * u + v * v));
    if (unclamped < walk_.alpha_min) return true;
    const float alpha = std::min(unclamped, walk_.alpha_max), after = transmittance_ * (1 - alpha);
    if (after <= walk_.transmittance_min) return false;
    double shine = 0;
    for (int c = 0; c < walk_.channels; c++) shine += double(gradient_[c]) * walk_.values[int64_t(i) * walk_.channels + c];
    behind_ -= double(alpha) * transmittance_ * shine;
    if (unclamped <= walk_.alpha_max) {  // no gradient flows through a clamped alpha
      const double by_exponent = (transmittance_ * shine - behind_ / (1 - alpha)) * alpha;
      walk_.sums[2 * i] += float(std::abs(by_exponent * (walk_.ux[i] * u)));
      walk_.sums[2 * i + 1] += float(std::abs(by_exponent * (walk_.uy[i] * u + walk_.vy[i] * v)));
    }
    transmittance_ = after;
    return true;
  }

 private:
  const Walk& walk_;
  const float* gradient_;
  float column_, row_, transmittance_ = 1;
  double behind_ = 0;  // gradient times the light that comes from behind the fragments so far
};

void walk_tile(const Walk& walk, int left, int top, std::vector<int>& touching) {
  const int right = std::min(left + TILE, walk.width), bottom = std::min(top + TILE, walk.height);
  touching.clear();
  for (int i = 0; i < walk.count; i++) {
    const bool across = walk.x[i] + walk.reach_x[i] >= left && walk.x[i] - walk.reach_x[i] <= right;
    if (across && walk.y[i] + walk.reach_y[i] >= top && walk.y[i] - walk.reach_y[i] <= bottom) touching.push_back(i);
  }
  for (int row = top; row < bottom; row++)
    for (int column = left; column < right; column++) {
      Pixel pixel(walk, column, row);
      for (int i : touching)
        if (!pixel.add(i)) break;
    }
}

}  // namespace d2

extern "C" {

int64_t d2_walk_size() { return sizeof(d2::Walk); }

void d2_absolute(const d2::Walk* walk) {
  std::vector<int> touching;
  for (int top = 0; top < walk->height; top += d2::TILE)
    for (int left = 0; left < walk->width; left += d2::TILE) d2::walk_tile(*walk, left, top, touching);
}
}
