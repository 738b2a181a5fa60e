// An arm among obstacles: collision checks of states, edges and paths, also between the checked states.
//
// A path is free over an interval if, in the middle of the interval, every pair of shapes is farther apart than the two
// can approach within the interval. So a check takes the middle, drops the pairs that are proven for the whole
// interval, and halves the interval for the others. It ends when no pair is left, or when the motion within an interval
// is below a resolution; there a free state stands for the interval. Distances come first from spheres that cover the
// arm's shapes, eight at a time, which give a lower bound. Where the bound does not decide, they come from GJK on the
// shapes themselves. No check is approximate: a state collides if and only if two shapes are within the margin.
#pragma once

#include <functional>
#include <memory>
#include <vector>

#include "arm.hpp"

namespace roboxim {

// A shape that moves with a joint: part of the arm, or of a held body.
struct Item {
  int joint = -1;  // -1: the base
  Shape shape;
  Transform local;  // in the joint's frame
  Vec3 center;      // bounding sphere, in the joint's frame
  double radius = 0.0;
  std::vector<float> sx, sy, sz, sr;  // spheres that cover it, in the joint's frame, a multiple of eight
};

// Spheres: rows of (x, y, z, radius) in the joint's frame that together cover the shape.
std::shared_ptr<const Item> make_item(int joint, Shape shape, const Transform& local, const double* spheres,
                                      std::size_t count);

struct Solid {
  Shape shape;
  Transform pose;
  int child = 0, children = 0;  // of a mesh: range of the parts that this box encloses; none: the box itself is solid
};

using Mesh = std::vector<Solid>;  // in the mesh's frame, the outermost box first

// Corners: nine numbers per triangle.
std::shared_ptr<const Mesh> make_mesh(const double* corners, std::size_t count);

struct Obstacle {
  Solid solid;                       // pose in the base; its shape is not used if there is a mesh
  std::shared_ptr<const Mesh> mesh;  // or none
};

// Margins of a check. A check whose resolution is at most its margin proves that a path touches nothing.
struct Margins {
  double margin = 0.0;        // distance from obstacles at or below which the arm counts as touching [m]
  double self_margin = 0.0;   // the same between the arm's own parts
  double resolution = 1e-3;   // motion below which a free state stands for its interval [m]
  std::vector<float> pairs;   // or a margin for each pair of `World::clearances`, which is also the pair's resolution
                              // if it is larger than `resolution`
};

// The tool's axis stays within an angle of a direction.
struct Upright {
  bool active = false;
  Vec3 axis;       // unit, in the TCP's frame
  Vec3 direction;  // unit, in the base
  double tolerance = 4.0;
};

class World {
 public:
  World(std::shared_ptr<const Arm> arm, std::vector<std::shared_ptr<const Item>> items,
        std::vector<Obstacle> obstacles, const std::vector<int>& item_pairs, const std::vector<int>& obstacle_pairs);

  // Whether a polyline of `count` states is free, ends included (one: that state). Checks far-apart places first.
  bool path_is_free(const double* path, int count, const Margins& margins) { return search(path, count, margins, nullptr); }

  // The first place at which the polyline is not free, 1.5 is midway between points 1 and 2; negative: it is free.
  double first_hit(const double* path, int count, const Margins& margins);

  // Random shortcuts of a free polyline; returns one that is no longer. See world.cpp.
  std::vector<double> shorten(const double* path, int count, std::uint64_t seed, int tries, const Margins& margins,
                              const double* weights);

  // A free path from a state to one of several goals that keeps the tool upright; empty when the iterations are spent.
  // See upright.cpp. `watch` is called regularly with the iterations spent; it ends the search by throwing.
  std::vector<double> connect_upright(const double* start, const double* goals, int goal_count, std::uint64_t seed,
                                      int iterations, double step, const Margins& margins,
                                      const std::function<void(int)>& watch);

  // The largest distances from the waypoints of a polyline, at most `largest` [rad], at which free blends may begin and
  // end; one per inner waypoint, 0 where no blend is free. See `blend_points` in timing.py.
  std::vector<double> blends(const double* path, int count, double largest, int halvings, const Margins& margins);

  // Tilt of the tool at a state [rad].
  double tilt(const double* q);

  // Smallest distance of any pair at a state, a lower bound within 1e-7 m; at most `cap`.
  double clearance(const double* q, double cap);

  // The same for each pair over several states: pairs of the arm's own parts first, in the given order.
  std::vector<double> clearances(const double* states, int count, double cap);

  Upright upright;
  const Arm& arm() const { return *arm_; }
  int pairs() const { return static_cast<int>(roots_.size()); }
  long long states_checked = 0;

 private:
  struct Pair {
    int item;
    int other;  // item or obstacle
    bool own;   // whether `other` is an item
    int part;   // of the obstacle's mesh
    float margin, resolution;
  };
  static Pair part_of(Pair pair, int part);
  struct Interval {
    double from, to;
    std::size_t begin, end;  // pairs in the arena
    bool upright;            // whether the constraint is still to be proven
  };
  struct Placed {
    long long epoch = -1;
    Transform pose;
    Vec3 center;
    std::vector<Lanes> x, y, z;
    std::vector<double> travel;  // largest motion of its points relative to each joint's frame; [0]: the base
  };

  bool search(const double* path, int count, const Margins& margins, double* where);
  bool earliest(const Interval& interval, double& where, int depth);
  bool check_middle(const Interval& interval, bool& upright_left);
  bool touches(const Pair& pair);
  bool upright_fails(bool& left) const;
  double tilt_now() const;
  bool straighten(double* q);
  void load(const double* path, int count);
  void apply_margins(const Margins& margins);
  double gap(const Pair& pair, double cap);
  void place_at(double t);
  void find_bends();
  void turn_along(const Interval& interval);
  double variation(int joint, double t) const;
  Placed& placed(int item);
  double bound_obstacle(const Item& item, const Placed& at, const Shape& shape, const Transform& pose) const;
  // The obstacle of a pair, or the part of its mesh, and its pose in the base.
  const Solid& solid_of(const Pair& pair, Transform& pose) const;
  double bound_own(const Item& a, const Placed& at, const Item& b, const Placed& bt) const;
  double mutual_travel(int a, int b);
  int ancestor(int a, int b) const;

  std::shared_ptr<const Arm> arm_;
  std::vector<std::shared_ptr<const Item>> items_;
  std::vector<Obstacle> obstacles_;
  std::vector<Pair> roots_;
  std::vector<Pair> active_;  // the same with the margins of the current check

  // scratch
  std::vector<Placed> placed_;
  std::vector<Transform> frames_;
  std::vector<double> q_, spread_, path_, variation_;
  std::vector<int> bends_;            // number of bends of the path before each of its points
  std::vector<Vec3> turns_, shifts_;  // on a straight interval: each joint's motion in half of it, extrapolated from
                                      // its middle: a rotation vector, and the motion of the point at the base's origin
  bool straight_ = false;
  std::vector<Pair> arena_, work_, stack_;
  std::vector<Interval> queue_;
  int points_ = 0;
  long long epoch_ = 0;
};

}  // namespace roboxim
