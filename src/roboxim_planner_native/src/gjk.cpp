#include "geometry.hpp"

namespace roboxim {
namespace {

constexpr double kRelative = 1e-9;  // of the squared distance
constexpr double kTouching = 1e-20;  // squared distance below which the shapes overlap [m^2]
constexpr int kIterations = 100;

struct Simplex {
  Vec3 p[4];
  int count = 0;

  void keep(int a) { p[0] = p[a], count = 1; }
  void keep(int a, int b) {
    const Vec3 u = p[a], v = p[b];
    p[0] = u, p[1] = v, count = 2;
  }
  void keep(int a, int b, int c) {
    const Vec3 u = p[a], v = p[b], w = p[c];
    p[0] = u, p[1] = v, p[2] = w, count = 3;
  }
};

// Closest point to the origin on segment a b of the simplex; `mask` tells which vertices span it.
Vec3 on_segment(const Vec3* p, int a, int b, int& mask) {
  const Vec3 ab = p[b] - p[a];
  const double length = dot(ab, ab), t = -dot(p[a], ab);
  if (t <= 0.0 || length <= 0.0) return mask = 1 << a, p[a];
  if (t >= length) return mask = 1 << b, p[b];
  mask = 1 << a | 1 << b;
  return p[a] + (t / length) * ab;
}

// The same on a triangle (Ericson, Real-Time Collision Detection, 5.1.5).
Vec3 on_triangle(const Vec3* p, int ia, int ib, int ic, int& mask) {
  const Vec3 &a = p[ia], &b = p[ib], &c = p[ic];
  const Vec3 ab = b - a, ac = c - a;
  const double d1 = -dot(ab, a), d2 = -dot(ac, a);
  if (d1 <= 0.0 && d2 <= 0.0) return mask = 1 << ia, a;
  const double d3 = -dot(ab, b), d4 = -dot(ac, b);
  if (d3 >= 0.0 && d4 <= d3) return mask = 1 << ib, b;
  const double d5 = -dot(ab, c), d6 = -dot(ac, c);
  if (d6 >= 0.0 && d5 <= d6) return mask = 1 << ic, c;
  const double vc = d1 * d4 - d3 * d2, vb = d5 * d2 - d1 * d6, va = d3 * d6 - d5 * d4;
  const double total = va + vb + vc;
  const bool inside = va > 0.0 && vb > 0.0 && vc > 0.0;
  if (inside && std::isfinite(1.0 / total)) {
    mask = 1 << ia | 1 << ib | 1 << ic;
    return a + (vb / total) * ab + (vc / total) * ac;
  }
  Vec3 best;
  double least = 1e300;
  const int edges[3][2] = {{ia, ib}, {ia, ic}, {ib, ic}};
  for (const auto& edge : edges) {
    int found = 0;
    const Vec3 q = on_segment(p, edge[0], edge[1], found);
    if (dot(q, q) < least) least = dot(q, q), best = q, mask = found;
  }
  return best;
}

// Closest point of the simplex to the origin; reduces the simplex to the vertices that span the point. All four stay
// when the origin is inside.
Vec3 reduce(Simplex& s) {
  int mask = 1;
  Vec3 best = s.p[0];
  if (s.count == 2) {
    best = on_segment(s.p, 0, 1, mask);
  } else if (s.count == 3) {
    best = on_triangle(s.p, 0, 1, 2, mask);
  } else if (s.count == 4) {
    const int faces[4][4] = {{0, 1, 2, 3}, {0, 1, 3, 2}, {0, 2, 3, 1}, {1, 2, 3, 0}};
    double least = 1e300;
    bool outside = false;
    const Vec3 edges[3] = {s.p[1] - s.p[0], s.p[2] - s.p[0], s.p[3] - s.p[0]};
    const double volume = std::abs(dot(edges[0], cross(edges[1], edges[2])));
    const double scale = norm(edges[0]) * norm(edges[1]) * norm(edges[2]);
    const bool flat = volume <= 1e-14 * scale;
    for (const auto& f : faces) {
      const Vec3 n = cross(s.p[f[1]] - s.p[f[0]], s.p[f[2]] - s.p[f[0]]);
      const double of_fourth = dot(n, s.p[f[3]] - s.p[f[0]]), of_origin = -dot(n, s.p[f[0]]);
      if (!flat && of_fourth * of_origin > 0.0) continue;
      outside = true;
      int found = 0;
      const Vec3 q = on_triangle(s.p, f[0], f[1], f[2], found);
      if (dot(q, q) < least) least = dot(q, q), best = q, mask = found;
    }
    if (!outside) return {};
  }
  int kept[4], count = 0;
  for (int i = 0; i < s.count; ++i)
    if (mask >> i & 1) kept[count++] = i;
  if (count == 1) s.keep(kept[0]);
  if (count == 2) s.keep(kept[0], kept[1]);
  if (count == 3) s.keep(kept[0], kept[1], kept[2]);
  return best;
}

}  // namespace

double distance(const Shape& a, const Transform& pose_a, const Shape& b, const Transform& pose_b, double near,
                double far) {
  const double radii = a.radius + b.radius;
  const double stop_near = near + radii, stop_far = far + radii;
  const auto difference = [&](const Vec3& d) {  // support of a - b
    return pose_a * a.support(transposed_times(pose_a.r, d)) - pose_b * b.support(-transposed_times(pose_b.r, d));
  };
  Vec3 v = pose_a * (0.5 * (a.low + a.high)) - pose_b * (0.5 * (b.low + b.high));
  if (dot(v, v) < 1e-12) v = {1.0, 0.0, 0.0};
  Simplex simplex;
  double lower = 0.0;
  const Vec3 first = difference(-v);
  lower = std::max(0.0, dot(v, first) / norm(v));
  if (lower > stop_far) return lower - radii;
  v = simplex.p[0] = first;
  simplex.count = 1;
  for (int i = 0; i < kIterations; ++i) {
    const double squared = dot(v, v);
    if (squared <= kTouching || (stop_near > 0.0 && squared <= stop_near * stop_near)) {
      return std::max(0.0, std::sqrt(squared) - radii);
    }
    const Vec3 w = difference(-v);
    const double along = dot(v, w);
    lower = std::max(lower, along / std::sqrt(squared));
    if (lower > stop_far || squared - along <= kRelative * squared) break;
    bool known = false;
    for (int k = 0; k < simplex.count; ++k) {
      const Vec3 apart = simplex.p[k] - w;
      known = known || dot(apart, apart) <= 1e-24;
    }
    if (known) break;  // no progress within rounding
    simplex.p[simplex.count++] = w;
    const Vec3 next = reduce(simplex);
    if (simplex.count == 4) return 0.0;
    if (dot(next, next) >= squared) break;
    v = next;
  }
  return std::max(0.0, lower - radii);
}

}  // namespace roboxim
