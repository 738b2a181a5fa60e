#include "world.hpp"

#include <limits>

namespace roboxim {
namespace {

constexpr double kSlack = 1e-6;        // covers single-precision errors in the spheres' bounds [m]
constexpr double kWorthExact = 0.04;   // intervals with less motion than this are proven by exact distances [m]
constexpr int kDeepest = 40;
constexpr double kBend = 1e-10;        // deviation from the straight line that counts as a bend [rad]

}  // namespace

World::Pair World::part_of(Pair pair, int part) {
  pair.part = part;
  return pair;
}

std::shared_ptr<const Item> make_item(int joint, Shape shape, const Transform& local, const double* spheres,
                                      std::size_t count) {
  if (count == 0) throw std::invalid_argument("an item needs spheres that cover it");
  auto item = std::make_shared<Item>();
  item->joint = joint;
  item->local = local;
  item->center = local * (0.5 * (shape.low + shape.high));
  item->radius = 0.5 * norm(shape.high - shape.low);
  item->shape = std::move(shape);
  for (std::size_t i = 0; i < (count + kLanes - 1) / kLanes * kLanes; ++i) {
    const double* s = spheres + 4 * (i < count ? i : 0);
    item->sx.push_back(static_cast<float>(s[0]));
    item->sy.push_back(static_cast<float>(s[1]));
    item->sz.push_back(static_cast<float>(s[2]));
    item->sr.push_back(static_cast<float>(s[3]));
  }
  return item;
}

World::World(std::shared_ptr<const Arm> arm, std::vector<std::shared_ptr<const Item>> items,
             std::vector<Obstacle> obstacles, const std::vector<int>& item_pairs,
             const std::vector<int>& obstacle_pairs)
    : arm_(std::move(arm)),
      items_(std::move(items)),
      obstacles_(std::move(obstacles)),
      placed_(items_.size()),
      frames_(arm_->joints.size()),
      q_(arm_->joints.size()),
      spread_(arm_->joints.size()),
      turns_(arm_->joints.size()),
      shifts_(arm_->joints.size()) {
  const int count = static_cast<int>(items_.size()), solids = static_cast<int>(obstacles_.size());
  for (std::size_t i = 0; i + 1 < item_pairs.size(); i += 2) {
    const int a = item_pairs[i], b = item_pairs[i + 1];
    if (a < 0 || b < 0 || a >= count || b >= count) throw std::out_of_range("item pair");
    roots_.push_back({a, b, true, 0, 0.0f, 0.0f});
  }
  for (std::size_t i = 0; i + 1 < obstacle_pairs.size(); i += 2) {
    const int a = obstacle_pairs[i], b = obstacle_pairs[i + 1];
    if (a < 0 || b < 0 || a >= count || b >= solids) throw std::out_of_range("obstacle pair");
    roots_.push_back({a, b, false, 0, 0.0f, 0.0f});
  }
  for (std::size_t i = 0; i < items_.size(); ++i) {
    if (items_[i]->joint >= arm_->dof()) throw std::out_of_range("item of an unknown joint");
    const std::size_t groups = items_[i]->sx.size() / kLanes;
    placed_[i].x.resize(groups);
    placed_[i].y.resize(groups);
    placed_[i].z.resize(groups);
    placed_[i].travel.resize(arm_->joints.size() + 1);
  }
}

void World::load(const double* path, int count) {
  straight_ = false;
  const int n = arm_->dof();
  points_ = count;
  path_.assign(path, path + static_cast<std::ptrdiff_t>(count) * n);
  variation_.assign(static_cast<std::size_t>(count) * n, 0.0);
  for (int i = 1; i < count; ++i) {
    for (int j = 0; j < n; ++j) {
      variation_[i * n + j] = variation_[(i - 1) * n + j] + std::abs(path_[i * n + j] - path_[(i - 1) * n + j]);
    }
  }
}

// Counts the bends of the path: the points at which it leaves its straight line, or turns back, by more than rounding.
void World::find_bends() {
  const int n = arm_->dof();
  bends_.assign(static_cast<std::size_t>(points_) + 1, 0);
  const double* begin = path_.data();  // of the current straight part
  for (int i = 0; i < points_; ++i) {
    bool bends = false;
    if (i + 1 < points_) {
      const double *now = &path_[i * n], *next = now + n;
      double chord = 0.0, along = 0.0, ahead = 0.0;
      for (int j = 0; j < n; ++j) {
        chord += (now[j] - begin[j]) * (now[j] - begin[j]);
        along += (now[j] - begin[j]) * (next[j] - begin[j]);
        ahead += (now[j] - begin[j]) * (next[j] - now[j]);
      }
      for (int j = 0; j < n && chord > 0.0; ++j) {
        bends = bends || std::abs(next[j] - begin[j] - along / chord * (now[j] - begin[j])) > kBend;
      }
      bends = bends || ahead < 0.0;
      if (bends) begin = now;
    }
    bends_[i + 1] = bends_[i] + bends;
  }
}

// Computes the first-order motion of the joints' frames on an interval without a bend.
void World::turn_along(const Interval& interval) {
  const int n = arm_->dof(), first = static_cast<int>(interval.from) + 1;
  const int last = static_cast<int>(std::ceil(interval.to)) - 1;  // points strictly inside
  straight_ = last < first || bends_[last + 1] == bends_[first];
  if (!straight_) return;
  const int from = std::min(static_cast<int>(interval.from), points_ - 1);
  const int to = std::min(static_cast<int>(std::ceil(interval.to)), points_ - 1);
  for (int j = 0; j < n; ++j) {
    const Joint& joint = arm_->joints[j];
    const double change = path_[to * n + j] < path_[from * n + j] ? -spread_[j] : spread_[j];
    const Vec3 axis = frames_[j].r * joint.axis;
    turns_[j] = joint.parent < 0 ? Vec3{} : turns_[joint.parent];
    shifts_[j] = joint.parent < 0 ? Vec3{} : shifts_[joint.parent];
    if (joint.prismatic) {
      shifts_[j] = shifts_[j] + change * axis;
    } else {
      turns_[j] = turns_[j] + change * axis;
      shifts_[j] = shifts_[j] + change * cross(frames_[j].t, axis);
    }
  }
}

void World::apply_margins(const Margins& margins) {
  active_ = roots_;
  for (std::size_t i = 0; i < active_.size(); ++i) {
    Pair& pair = active_[i];
    pair.resolution = static_cast<float>(margins.resolution);
    if (margins.pairs.empty()) {
      pair.margin = static_cast<float>(pair.own ? margins.self_margin : margins.margin);
    } else {
      pair.margin = margins.pairs[i];
      pair.resolution = std::max(pair.resolution, pair.margin);
    }
  }
}

double World::variation(int joint, double t) const {
  const int n = arm_->dof(), i = std::min(static_cast<int>(t), points_ - 1), next = std::min(i + 1, points_ - 1);
  const double a = variation_[i * n + joint], b = variation_[next * n + joint];
  return a + (t - i) * (b - a);
}

void World::place_at(double t) {
  const int n = arm_->dof(), i = std::min(static_cast<int>(t), points_ - 1), next = std::min(i + 1, points_ - 1);
  for (int j = 0; j < n; ++j) {
    const double a = path_[i * n + j], b = path_[next * n + j];
    q_[j] = a + (t - i) * (b - a);
  }
  arm_->forward(q_.data(), frames_.data());
  ++epoch_;
  ++states_checked;
}

// Places an item for the current state of the arm and bounds the motion of its points within the interval, relative to
// the frame of each joint that moves it. The bound is built joint by joint from the tip: a rotation by d about an axis
// moves a point by at most d times its distance from the axis. That distance exceeds the current one by at most the
// motion that the joints further out cause.
//
// Where the path is straight there is a second bound, and the smaller one counts: the first-order motion, in which
// joints that turn against each other cancel, plus half the largest second derivative. The second derivative of a point
// with respect to the angles of two joints is at most its distance from the outer joint's axis.
World::Placed& World::placed(int index) {
  Placed& at = placed_[index];
  if (at.epoch == epoch_) return at;
  at.epoch = epoch_;
  const Item& item = *items_[index];
  const Transform frame = item.joint < 0 ? Transform{} : frames_[item.joint];
  at.pose = frame * item.local;
  at.center = frame * item.center;
  const double* r = frame.r.m;
  for (std::size_t g = 0; g < at.x.size(); ++g) {
    Lanes x, y, z;
    __builtin_memcpy(&x, &item.sx[g * kLanes], sizeof x);
    __builtin_memcpy(&y, &item.sy[g * kLanes], sizeof y);
    __builtin_memcpy(&z, &item.sz[g * kLanes], sizeof z);
    const float m[9] = {float(r[0]), float(r[1]), float(r[2]), float(r[3]), float(r[4]),
                        float(r[5]), float(r[6]), float(r[7]), float(r[8])};
    at.x[g] = m[0] * x + m[1] * y + m[2] * z + float(frame.t.x);
    at.y[g] = m[3] * x + m[4] * y + m[5] * z + float(frame.t.y);
    at.z[g] = m[6] * x + m[7] * y + m[8] * z + float(frame.t.z);
  }
  double travel = 0.0, sum = 0.0, second = 0.0;
  for (int j = item.joint; j >= 0; j = arm_->joints[j].parent) {
    at.travel[j + 1] = travel;
    const Joint& joint = arm_->joints[j];
    const double change = spread_[j];
    double step = change;
    if (!joint.prismatic) {
      const Vec3 axis = frames_[j].r * joint.axis;
      step *= norm(cross(axis, at.center - frames_[j].t)) + item.radius + travel;
      second += change * (step + 2.0 * sum);
    }
    sum += step;
    travel += step;
    if (straight_) {
      const Vec3 turn = joint.parent < 0 ? turns_[item.joint] : turns_[item.joint] - turns_[joint.parent];
      const Vec3 shift = joint.parent < 0 ? shifts_[item.joint] : shifts_[item.joint] - shifts_[joint.parent];
      const double first = norm(shift + cross(turn, at.center)) + norm(turn) * item.radius;
      travel = std::min(travel, first + 0.5 * second + kSlack);
    }
  }
  at.travel[0] = travel;
  return at;
}

int World::ancestor(int a, int b) const {
  while (a != b) {
    if (a > b) {
      a = arm_->joints[a].parent;
    } else {
      b = arm_->joints[b].parent;
    }
  }
  return a;
}

double World::mutual_travel(int a, int b) {
  const int common = ancestor(items_[a]->joint, items_[b]->joint) + 1;
  return placed(a).travel[common] + placed(b).travel[common];
}

const Solid& World::solid_of(const Pair& pair, Transform& pose) const {
  const Obstacle& obstacle = obstacles_[pair.other];
  pose = obstacle.solid.pose;
  if (!obstacle.mesh) return obstacle.solid;
  const Solid& part = (*obstacle.mesh)[pair.part];
  pose = pose * part.pose;
  return part;
}

double World::bound_obstacle(const Item& item, const Placed& at, const Shape& shape, const Transform& pose) const {
  const double* r = pose.r.m;
  const Vec3 middle = 0.5 * (shape.low + shape.high), half = 0.5 * (shape.high - shape.low);
  const Vec3 shift = -transposed_times(pose.r, pose.t) - middle;
  const float m[9] = {float(r[0]), float(r[3]), float(r[6]), float(r[1]), float(r[4]),
                      float(r[7]), float(r[2]), float(r[5]), float(r[8])};
  Lanes least = lanes(std::numeric_limits<float>::max());
  for (std::size_t g = 0; g < at.x.size(); ++g) {
    const Lanes x = m[0] * at.x[g] + m[1] * at.y[g] + m[2] * at.z[g] + float(shift.x);
    const Lanes y = m[3] * at.x[g] + m[4] * at.y[g] + m[5] * at.z[g] + float(shift.y);
    const Lanes z = m[6] * at.x[g] + m[7] * at.y[g] + m[8] * at.z[g] + float(shift.z);
    Lanes radius;
    __builtin_memcpy(&radius, &item.sr[g * kLanes], sizeof radius);
    Lanes squared;
    if (shape.kind == Shape::Kind::cylinder) {
      const Lanes dr = lane_max(lane_sqrt(x * x + y * y) - float(half.x), Lanes{});
      const Lanes dz = lane_max(lane_abs(z) - float(half.z), Lanes{});
      squared = dr * dr + dz * dz;
    } else if (shape.kind == Shape::Kind::points && shape.radius > 0.0) {  // sphere or capsule along z
      const float length = float(half.z - shape.radius), swept = float(shape.radius);
      const Lanes dz = lane_max(lane_abs(z) - length, Lanes{});
      const Lanes apart = lane_max(lane_sqrt(x * x + y * y + dz * dz) - swept, Lanes{});
      squared = apart * apart;
    } else {
      const Lanes dx = lane_max(lane_abs(x) - float(half.x), Lanes{});
      const Lanes dy = lane_max(lane_abs(y) - float(half.y), Lanes{});
      const Lanes dz = lane_max(lane_abs(z) - float(half.z), Lanes{});
      squared = dx * dx + dy * dy + dz * dz;
    }
    least = lane_min(least, lane_sqrt(squared) - radius);
  }
  return static_cast<double>(smallest(least)) - kSlack;
}

double World::bound_own(const Item& a, const Placed& at, const Item& b, const Placed& bt) const {
  Lanes least = lanes(std::numeric_limits<float>::max());
  for (std::size_t h = 0; h < b.sx.size(); ++h) {
    const std::size_t group = h / kLanes, lane = h % kLanes;
    const float bx = bt.x[group][lane], by = bt.y[group][lane], bz = bt.z[group][lane], br = b.sr[h];
    for (std::size_t g = 0; g < at.x.size(); ++g) {
      const Lanes x = at.x[g] - bx, y = at.y[g] - by, z = at.z[g] - bz;
      Lanes radius;
      __builtin_memcpy(&radius, &a.sr[g * kLanes], sizeof radius);
      least = lane_min(least, lane_sqrt(x * x + y * y + z * z) - radius - br);
    }
  }
  return static_cast<double>(smallest(least)) - kSlack;
}

// Checks the middle of an interval. Returns true if it is not free there. Appends to the arena the pairs that must be
// checked again in the interval's halves.
bool World::check_middle(const Interval& interval, bool& upright_left) {
  const double middle = 0.5 * (interval.from + interval.to);
  for (int j = 0; j < arm_->dof(); ++j) {
    const double at = variation(j, middle);
    spread_[j] = std::max(at - variation(j, interval.from), variation(j, interval.to) - at);
  }
  place_at(middle);
  turn_along(interval);
  upright_left = interval.upright;
  if (interval.upright && upright_fails(upright_left)) return true;
  work_.assign(arena_.begin() + static_cast<std::ptrdiff_t>(interval.begin),
               arena_.begin() + static_cast<std::ptrdiff_t>(interval.end));
  for (std::size_t i = 0; i < work_.size(); ++i) {
    const Pair pair = work_[i];
    const Item& item = *items_[pair.item];
    const Placed& at = placed(pair.item);
    const double margin = pair.margin;
    double travel, bound;
    Transform pose;
    const Solid* solid = nullptr;
    if (pair.own) {
      const Item& other = *items_[pair.other];
      const Placed& bt = placed(pair.other);
      travel = mutual_travel(pair.item, pair.other);
      bound = norm(at.center - bt.center) - item.radius - other.radius;
      if (bound > margin + travel) continue;
      bound = std::max(bound, bound_own(item, at, other, bt));
    } else {
      travel = at.travel[0];
      solid = &solid_of(pair, pose);
      bound = bound_obstacle(item, at, solid->shape, pose);
    }
    if (bound > margin + travel) continue;
    if (solid && solid->children) {
      if (norm(solid->shape.half) > travel) {  // worth splitting: the parts may be proven one by one
        for (int k = 0; k < solid->children; ++k) work_.push_back(part_of(pair, solid->child + k));
        continue;
      }
      if (bound <= margin && touches(pair)) return true;
      if (travel > pair.resolution) arena_.push_back(pair);
      continue;
    }
    const bool worth_exact = travel < kWorthExact;
    if (bound <= margin || worth_exact) {
      const Shape& shape = solid ? solid->shape : items_[pair.other]->shape;
      if (!solid) pose = placed(pair.other).pose;
      const double far = worth_exact ? margin + travel : margin;
      const double apart = distance(item.shape, at.pose, shape, pose, margin, far);
      if (apart <= margin) return true;
      if (apart > margin + travel) continue;
    }
    if (travel > pair.resolution) arena_.push_back(pair);
  }
  return false;
}

// Whether an item touches a part of a mesh at the current state of the arm.
bool World::touches(const Pair& pair) {
  const Item& item = *items_[pair.item];
  const Placed& at = placed(pair.item);
  stack_.assign(1, pair);
  while (!stack_.empty()) {
    const Pair next = stack_.back();
    stack_.pop_back();
    Transform pose;
    const Solid& solid = solid_of(next, pose);
    if (bound_obstacle(item, at, solid.shape, pose) > pair.margin) continue;
    for (int k = 0; k < solid.children; ++k) stack_.push_back(part_of(next, solid.child + k));
    if (solid.children) continue;
    if (distance(item.shape, at.pose, solid.shape, pose, pair.margin, pair.margin) <= pair.margin) return true;
  }
  return false;
}

bool World::upright_fails(bool& left) const {
  double turn = 0.0;
  for (int j = 0; j < arm_->dof(); ++j) {
    if (arm_->moves_tcp[j] && !arm_->joints[j].prismatic) turn += spread_[j];
  }
  const double tilted = tilt_now();
  if (tilted > upright.tolerance) return true;
  left = tilted + turn > upright.tolerance && turn > 1e-3;
  return false;
}

bool World::search(const double* path, int count, const Margins& margins, double* where) {
  apply_margins(margins);
  load(path, count);
  find_bends();
  arena_ = active_;
  queue_.clear();
  queue_.push_back({0.0, static_cast<double>(count - 1), 0, arena_.size(), upright.active});
  for (std::size_t i = 0; i < queue_.size(); ++i) {
    const Interval now = queue_[i];
    const std::size_t begin = arena_.size();
    bool upright_left = false;
    if (check_middle(now, upright_left)) {
      if (where) *where = 0.5 * (now.from + now.to);
      return false;
    }
    if (arena_.size() == begin && !upright_left) continue;
    const double middle = 0.5 * (now.from + now.to);
    queue_.push_back({now.from, middle, begin, arena_.size(), upright_left});
    queue_.push_back({middle, now.to, begin, arena_.size(), upright_left});
  }
  return true;
}

double World::first_hit(const double* path, int count, const Margins& margins) {
  double where = -1.0;
  if (search(path, count, margins, &where)) return -1.0;
  arena_ = active_;
  earliest({0.0, static_cast<double>(count - 1), 0, arena_.size(), upright.active}, where, 0);
  return where;
}

// Narrows `where`, a place that is known not to be free, to the first such place within the interval.
bool World::earliest(const Interval& interval, double& where, int depth) {
  if (interval.from >= where || depth > kDeepest) return false;
  const double middle = 0.5 * (interval.from + interval.to);
  const std::size_t begin = arena_.size();
  bool upright_left = false;
  const bool hit = check_middle(interval, upright_left);
  const std::size_t end = arena_.size();
  bool found = hit;
  if (hit) {
    where = std::min(where, middle);
    if (interval.to - interval.from > 1e-3) {
      earliest({interval.from, middle, interval.begin, interval.end, interval.upright}, where, depth + 1);
    }
  } else if (end > begin || upright_left) {
    found = earliest({interval.from, middle, begin, end, upright_left}, where, depth + 1) ||
            earliest({middle, interval.to, begin, end, upright_left}, where, depth + 1);
  }
  arena_.resize(begin);
  return found;
}

// The distance of a pair at the current state of the arm: a lower bound within 1e-7 m, at most `cap`.
double World::gap(const Pair& pair, double cap) {
  const Placed& at = placed(pair.item);
  const Item& item = *items_[pair.item];
  if (pair.own) {
    const Placed& bt = placed(pair.other);
    if (bound_own(item, at, *items_[pair.other], bt) >= cap) return cap;
    return std::min(cap, distance(item.shape, at.pose, items_[pair.other]->shape, bt.pose, 0.0, cap));
  }
  double least = cap;
  stack_.assign(1, pair);
  while (!stack_.empty()) {
    const Pair next = stack_.back();
    stack_.pop_back();
    Transform pose;
    const Solid& solid = solid_of(next, pose);
    if (bound_obstacle(item, at, solid.shape, pose) >= least) continue;
    for (int k = 0; k < solid.children; ++k) stack_.push_back(part_of(next, solid.child + k));
    if (solid.children == 0) least = std::min(least, distance(item.shape, at.pose, solid.shape, pose, 0.0, least));
  }
  return least;
}

double World::clearance(const double* q, double cap) {
  const std::vector<double> all = clearances(q, 1, cap);
  return all.empty() ? cap : *std::min_element(all.begin(), all.end());
}

std::vector<double> World::clearances(const double* states, int count, double cap) {
  std::vector<double> least(roots_.size(), cap);
  load(states, count);
  std::fill(spread_.begin(), spread_.end(), 0.0);
  for (int i = 0; i < count; ++i) {
    place_at(i);
    for (std::size_t k = 0; k < roots_.size(); ++k) least[k] = gap(roots_[k], least[k]);
  }
  return least;
}

namespace {

constexpr double kGain = 0.02;  // fraction of a path's length that a shortcut must save to be worth a check

using Path = std::vector<std::vector<double>>;

double length_of(const std::vector<double>& a, const std::vector<double>& b, const double* weights) {
  double sum = 0.0;
  for (std::size_t j = 0; j < a.size(); ++j) sum += weights[j] * weights[j] * (b[j] - a[j]) * (b[j] - a[j]);
  return std::sqrt(sum);
}

}  // namespace

// Drops waypoints; then replaces the path between two random places by the straight edge if that is free and shorter;
// then drops waypoints again. Lengths are Euclidean with `weights` per joint.
std::vector<double> World::shorten(const double* points, int count, std::uint64_t seed, int tries,
                                   const Margins& margins, const double* weights) {
  const int n = arm_->dof();
  Path path;
  for (int i = 0; i < count; ++i) path.emplace_back(points + i * n, points + (i + 1) * n);
  std::vector<double> edge(2 * static_cast<std::size_t>(n));
  const auto free = [&](const std::vector<double>& a, const std::vector<double>& b) {
    std::copy(a.begin(), a.end(), edge.begin());
    std::copy(b.begin(), b.end(), edge.begin() + n);
    return path_is_free(edge.data(), 2, margins);
  };
  const auto skip = [&] {
    for (std::size_t at = 0; at + 2 < path.size(); ++at) {
      for (std::size_t far = path.size() - 1; far > at + 1; --far) {
        if (!free(path[at], path[far])) continue;
        path.erase(path.begin() + static_cast<std::ptrdiff_t>(at) + 1, path.begin() + static_cast<std::ptrdiff_t>(far));
        break;
      }
    }
  };
  skip();
  Random random{seed * 0x9e3779b97f4a7c15ULL + 0x1d8e4e27c47d124fULL};
  int idle = 0;
  for (int turn = 0; turn < tries && path.size() > 2 && idle < 4 * static_cast<int>(path.size()) + 20; ++turn) {
    std::vector<double> ends{0.0};
    for (std::size_t i = 1; i < path.size(); ++i) ends.push_back(ends.back() + length_of(path[i - 1], path[i], weights));
    double first = random.uniform() * ends.back(), second = random.uniform() * ends.back();
    if (first > second) std::swap(first, second);
    const auto locate = [&](double place, std::vector<double>& q) {
      std::size_t i = 1;
      while (i + 1 < path.size() && ends[i] < place) ++i;
      const double part = (place - ends[i - 1]) / std::max(ends[i] - ends[i - 1], 1e-12);
      q.resize(n);
      for (int j = 0; j < n; ++j) q[j] = path[i - 1][j] + part * (path[i][j] - path[i - 1][j]);
      return i;
    };
    std::vector<double> a, b;
    const std::size_t i = locate(first, a), k = locate(second, b);
    ++idle;
    if (i == k || second - first - length_of(a, b, weights) < kGain * ends.back() || !free(a, b)) continue;
    idle = 0;
    Path shorter(path.begin(), path.begin() + static_cast<std::ptrdiff_t>(i));
    const auto add = [&](const std::vector<double>& q) {
      if (length_of(shorter.back(), q, weights) > 1e-7) shorter.push_back(q);
    };
    add(a);
    add(b);
    for (std::size_t rest = k; rest < path.size(); ++rest) add(path[rest]);
    shorter.back() = path.back();
    path = std::move(shorter);
  }
  skip();
  std::vector<double> result;
  for (const auto& q : path) result.insert(result.end(), q.begin(), q.end());
  return result;
}

std::vector<double> World::blends(const double* path, int count, double largest, int halvings,
                                  const Margins& margins) {
  constexpr int kSamples = 7;
  const int n = arm_->dof();
  std::vector<double> found(static_cast<std::size_t>(std::max(0, count - 2)), 0.0), curve(kSamples * n);
  const auto length = [&](int i) {
    double sum = 0.0;
    for (int j = 0; j < n; ++j) sum += (path[(i + 1) * n + j] - path[i * n + j]) * (path[(i + 1) * n + j] - path[i * n + j]);
    return std::sqrt(sum);
  };
  for (int i = 0; i + 2 < count; ++i) {
    const double before = length(i), after = length(i + 1);
    double distance = std::min({largest, 0.499 * before, 0.499 * after});
    for (int turn = 0; turn < halvings; ++turn, distance *= 0.5) {
      for (int k = 0; k < kSamples; ++k) {
        const double s = (k + 1.0) / (kSamples + 1.0), turned = s * s * s * (1.0 - 0.5 * s);
        for (int j = 0; j < n; ++j) {
          const double corner = path[(i + 1) * n + j];
          const double u = (corner - path[i * n + j]) / before, w = (path[(i + 2) * n + j] - corner) / after;
          curve[k * n + j] = corner - distance * u + 2.0 * distance * (u * s + (w - u) * turned);
        }
      }
      if (path_is_free(curve.data(), kSamples, margins)) {
        found[i] = distance;
        break;
      }
    }
  }
  return found;
}

}  // namespace roboxim
