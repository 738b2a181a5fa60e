// Vectors, rigid transforms and convex shapes, in plain double arithmetic without dependencies.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <stdexcept>
#include <string>
#include <vector>

namespace roboxim {

struct Vec3 {
  double x = 0.0, y = 0.0, z = 0.0;
};

inline Vec3 operator+(const Vec3& a, const Vec3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(const Vec3& a, const Vec3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator-(const Vec3& a) { return {-a.x, -a.y, -a.z}; }
inline Vec3 operator*(double s, const Vec3& a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(const Vec3& a, const Vec3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(const Vec3& a, const Vec3& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline double norm(const Vec3& a) { return std::sqrt(dot(a, a)); }

struct Mat3 {  // row major
  double m[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
};

inline Vec3 operator*(const Mat3& r, const Vec3& v) {
  const double* m = r.m;
  return {m[0] * v.x + m[1] * v.y + m[2] * v.z, m[3] * v.x + m[4] * v.y + m[5] * v.z,
          m[6] * v.x + m[7] * v.y + m[8] * v.z};
}
inline Vec3 transposed_times(const Mat3& r, const Vec3& v) {
  const double* m = r.m;
  return {m[0] * v.x + m[3] * v.y + m[6] * v.z, m[1] * v.x + m[4] * v.y + m[7] * v.z,
          m[2] * v.x + m[5] * v.y + m[8] * v.z};
}
inline Mat3 operator*(const Mat3& a, const Mat3& b) {
  Mat3 c;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      c.m[3 * i + j] = a.m[3 * i] * b.m[j] + a.m[3 * i + 1] * b.m[3 + j] + a.m[3 * i + 2] * b.m[6 + j];
  return c;
}

struct Transform {
  Mat3 r;
  Vec3 t;
};

inline Vec3 operator*(const Transform& a, const Vec3& v) { return a.r * v + a.t; }
inline Transform operator*(const Transform& a, const Transform& b) { return {a.r * b.r, a.r * b.t + a.t}; }

// Rotation about a unit axis.
inline Mat3 rotation(const Vec3& axis, double angle) {
  const double s = std::sin(angle), c = std::cos(angle), k = 1.0 - c;
  const auto [x, y, z] = axis;
  return {{c + k * x * x, k * x * y - s * z, k * x * z + s * y, k * x * y + s * z, c + k * y * y, k * y * z - s * x,
           k * x * z - s * y, k * y * z + s * x, c + k * z * z}};
}

// Eight single-precision lanes; the compiler splits them for narrower registers.
typedef float Lanes __attribute__((vector_size(32)));
constexpr int kLanes = 8;

inline Lanes lane_sqrt(Lanes a) {
  for (int i = 0; i < kLanes; ++i) a[i] = __builtin_sqrtf(a[i]);
  return a;
}
inline Lanes lane_max(Lanes a, Lanes b) { return a > b ? a : b; }
inline Lanes lane_min(Lanes a, Lanes b) { return a < b ? a : b; }
inline Lanes lane_abs(Lanes a) { return a < 0.0f ? -a : a; }
inline Lanes lanes(float value) { return value - Lanes{}; }
inline float smallest(Lanes a) {
  float least = a[0];
  for (int i = 1; i < kLanes; ++i) least = a[i] < least ? a[i] : least;
  return least;
}

typedef double Quad __attribute__((vector_size(32)));
typedef long long QuadIndex __attribute__((vector_size(32)));

// A convex core in its own frame, swept by a sphere of `radius`: a sphere is a swept point, a capsule a swept segment.
struct Shape {
  enum class Kind { points, box, cylinder };

  Kind kind = Kind::box;
  double radius = 0.0;
  Vec3 half;              // box: half extents; cylinder: (radius, radius, half height), axis z
  std::vector<double> x;  // points, padded to a multiple of 4 by repeating the first
  std::vector<double> y;
  std::vector<double> z;
  Vec3 low, high;  // bounding box in its frame, `radius` included

  static Shape box(const Vec3& half) {
    Shape s;
    s.half = half;
    s.low = -half;
    s.high = half;
    return s;
  }

  static Shape cylinder(double radius, double height) {
    Shape s;
    s.kind = Kind::cylinder;
    s.half = {radius, radius, 0.5 * height};
    s.low = -s.half;
    s.high = s.half;
    return s;
  }

  static Shape points(const double* xyz, std::size_t count, double radius) {
    if (count == 0) throw std::invalid_argument("a shape needs points");
    Shape s;
    s.kind = Kind::points;
    s.radius = radius;
    s.low = s.high = {xyz[0], xyz[1], xyz[2]};
    for (std::size_t i = 0; i < (count + 3) / 4 * 4; ++i) {
      const double* p = xyz + 3 * (i < count ? i : 0);
      s.x.push_back(p[0]);
      s.y.push_back(p[1]);
      s.z.push_back(p[2]);
      s.low = {std::min(s.low.x, p[0]), std::min(s.low.y, p[1]), std::min(s.low.z, p[2])};
      s.high = {std::max(s.high.x, p[0]), std::max(s.high.y, p[1]), std::max(s.high.z, p[2])};
    }
    s.low = s.low - Vec3{radius, radius, radius};
    s.high = s.high + Vec3{radius, radius, radius};
    return s;
  }

  // The point of the core (without the swept radius) that lies farthest along d.
  Vec3 support(const Vec3& d) const {
    switch (kind) {
      case Kind::box:
        return {std::copysign(half.x, d.x), std::copysign(half.y, d.y), std::copysign(half.z, d.z)};
      case Kind::cylinder: {
        const double across = std::sqrt(d.x * d.x + d.y * d.y);
        const double scale = across > 1e-300 ? half.x / across : 0.0;
        return {scale * d.x, scale * d.y, std::copysign(half.z, d.z)};
      }
      case Kind::points:
        break;
    }
    if (x.size() == 4) return farthest_of_four(d);
    Quad best = {-1e300, -1e300, -1e300, -1e300};
    QuadIndex where = {0, 0, 0, 0}, at = {0, 1, 2, 3};
    for (std::size_t i = 0; i < x.size(); i += 4) {
      Quad px, py, pz;
      __builtin_memcpy(&px, &x[i], sizeof px);
      __builtin_memcpy(&py, &y[i], sizeof py);
      __builtin_memcpy(&pz, &z[i], sizeof pz);
      const Quad along = px * d.x + py * d.y + pz * d.z;
      const auto better = along > best;
      best = better ? along : best;
      where = better ? at : where;
      at += 4;
    }
    int lane = 0;
    for (int k = 1; k < 4; ++k)
      if (best[k] > best[lane]) lane = k;
    const std::size_t i = static_cast<std::size_t>(where[lane]);
    return {x[i], y[i], z[i]};
  }

 private:
  Vec3 farthest_of_four(const Vec3& d) const {
    int best = 0;
    double most = -1e300;
    for (int i = 0; i < 4; ++i) {
      const double along = x[i] * d.x + y[i] * d.y + z[i] * d.z;
      if (along > most) {
        most = along;
        best = i;
      }
    }
    return {x[best], y[best], z[best]};
  }
};

// Distance of two posed convex shapes by GJK (Gilbert, Johnson, Keerthi 1988; termination after van den Bergen 1999).
//
// Returns 0 when they overlap. The search ends early:
// - a result <= `near` means that the distance is at most `near`;
// - a result > `far` means that the distance is at least the result;
// - in between, the result is a lower bound within 1e-7 m of the distance.
double distance(const Shape& a, const Transform& pose_a, const Shape& b, const Transform& pose_b, double near,
                double far);

}  // namespace roboxim
