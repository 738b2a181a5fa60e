#include <numeric>

#include "world.hpp"

namespace roboxim {
namespace {

constexpr int kLeaf = 4;

struct Triangle {
  double corners[9];
  double middle(int axis) const { return corners[axis] + corners[3 + axis] + corners[6 + axis]; }
};

Solid box_around(const std::vector<Triangle>& triangles, const std::vector<int>& members) {
  Vec3 low{1e300, 1e300, 1e300}, high{-1e300, -1e300, -1e300};
  for (const int member : members) {
    for (int k = 0; k < 3; ++k) {
      const double* p = triangles[member].corners + 3 * k;
      low = {std::min(low.x, p[0]), std::min(low.y, p[1]), std::min(low.z, p[2])};
      high = {std::max(high.x, p[0]), std::max(high.y, p[1]), std::max(high.z, p[2])};
    }
  }
  Solid box;
  box.shape = Shape::box(0.5 * (high - low));
  box.pose.t = 0.5 * (low + high);
  return box;
}

}  // namespace

// A tree of boxes around triangles, split at the median across the longest extent.
std::shared_ptr<const Mesh> make_mesh(const double* corners, std::size_t count) {
  if (count == 0) throw std::invalid_argument("a mesh needs triangles");
  std::vector<Triangle> triangles(count);
  for (std::size_t i = 0; i < count; ++i) std::copy(corners + 9 * i, corners + 9 * (i + 1), triangles[i].corners);
  auto mesh = std::make_shared<Mesh>();
  std::vector<std::pair<int, std::vector<int>>> pending(1);
  pending[0].second.resize(count);
  std::iota(pending[0].second.begin(), pending[0].second.end(), 0);
  mesh->push_back(box_around(triangles, pending[0].second));
  for (std::size_t next = 0; next < pending.size(); ++next) {
    const int index = pending[next].first;
    std::vector<int> members = std::move(pending[next].second);
    const int child = static_cast<int>(mesh->size());
    if (static_cast<int>(members.size()) <= kLeaf) {
      for (const int member : members) {
        Solid leaf;
        leaf.shape = Shape::points(triangles[member].corners, 3, 0.0);
        mesh->push_back(std::move(leaf));
      }
    } else {
      const Vec3 half = (*mesh)[index].shape.half;
      const int axis = half.x >= half.y && half.x >= half.z ? 0 : half.y >= half.z ? 1 : 2;
      std::stable_sort(members.begin(), members.end(),
                       [&](int a, int b) { return triangles[a].middle(axis) < triangles[b].middle(axis); });
      const auto middle = members.begin() + static_cast<std::ptrdiff_t>(members.size() / 2);
      for (auto& half_members : {std::vector<int>(members.begin(), middle), std::vector<int>(middle, members.end())}) {
        pending.emplace_back(static_cast<int>(mesh->size()), half_members);
        mesh->push_back(box_around(triangles, half_members));
      }
    }
    (*mesh)[index].child = child;
    (*mesh)[index].children = static_cast<int>(mesh->size()) - child;
  }
  return mesh;
}

}  // namespace roboxim
