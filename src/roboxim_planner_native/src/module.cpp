// The Python module. Arrays are C-contiguous float64; poses are (4, 4) matrices.

#include <pybind11/functional.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <numeric>

#include "world.hpp"

PYBIND11_MAKE_OPAQUE(roboxim::Mesh)

namespace py = pybind11;
using namespace roboxim;

namespace {

using Array = py::array_t<double, py::array::c_style | py::array::forcecast>;

Transform transform_of(const Array& matrix) {
  if (matrix.ndim() != 2 || matrix.shape(0) != 4 || matrix.shape(1) != 4) {
    throw std::invalid_argument("a pose is a matrix of shape (4, 4)");
  }
  const double* m = matrix.data();
  return {{{m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]}}, {m[3], m[7], m[11]}};
}

py::array_t<double> matrix_of(const Transform& pose) {
  py::array_t<double> matrix({4, 4});
  double* m = matrix.mutable_data();
  const double* r = pose.r.m;
  const double values[16] = {r[0], r[1], r[2], pose.t.x, r[3], r[4], r[5], pose.t.y,
                             r[6], r[7], r[8], pose.t.z, 0.0,  0.0,  0.0,  1.0};
  std::copy(values, values + 16, m);
  return matrix;
}

Vec3 vector_of(const Array& v) {
  if (v.size() != 3) throw std::invalid_argument("a vector has 3 numbers");
  return {v.data()[0], v.data()[1], v.data()[2]};
}

// Rows of width `width`; a flat array is one row.
int rows_of(const Array& array, int width, const char* what) {
  const bool flat = array.ndim() == 1 && array.shape(0) == width;
  const bool good = flat || (array.ndim() == 2 && array.shape(1) == width && array.shape(0) > 0);
  if (!good) throw std::invalid_argument(std::string(what) + ": expected rows of " + std::to_string(width));
  return flat ? 1 : static_cast<int>(array.shape(0));
}

Shape shape_of(const std::string& kind, const Array& values) {
  const double* v = values.data();
  if (kind == "box") return Shape::box(0.5 * vector_of(values));
  if (kind == "cylinder" && values.size() == 2) return Shape::cylinder(v[0], v[1]);
  if (kind == "sphere" && values.size() == 1) {
    const double origin[3] = {0.0, 0.0, 0.0};
    return Shape::points(origin, 1, v[0]);
  }
  if (kind == "capsule" && values.size() == 2) {
    const double ends[6] = {0.0, 0.0, -0.5 * v[1], 0.0, 0.0, 0.5 * v[1]};
    return Shape::points(ends, 2, v[0]);
  }
  if (kind == "hull") return Shape::points(v, static_cast<std::size_t>(rows_of(values, 3, "hull")), 0.0);
  throw std::invalid_argument("unknown shape or wrong number of sizes: " + kind);
}

std::shared_ptr<Arm> make_arm(const std::vector<int>& parents, const Array& placements, const Array& axes,
                              const std::vector<bool>& prismatic, const Array& lower, const Array& upper,
                              int tcp_joint, const Array& tcp) {
  const int n = static_cast<int>(parents.size());
  if (n == 0 || n > 64) throw std::invalid_argument("an arm has 1 to 64 joints");
  if (placements.size() != 16 * n || axes.size() != 3 * n || static_cast<int>(prismatic.size()) != n ||
      lower.size() != n || upper.size() != n || tcp_joint >= n) {
    throw std::invalid_argument("the arm's arrays must have one entry per joint");
  }
  auto arm = std::make_shared<Arm>();
  for (int j = 0; j < n; ++j) {
    if (parents[j] >= j) throw std::invalid_argument("parents come before their children");
    const double* m = placements.data() + 16 * j;
    const double* a = axes.data() + 3 * j;
    arm->joints.push_back({parents[j],
                           {{{m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]}}, {m[3], m[7], m[11]}},
                           {a[0], a[1], a[2]},
                           prismatic[j],
                           lower.data()[j],
                           upper.data()[j]});
  }
  arm->tcp_joint = tcp_joint;
  arm->tcp = transform_of(tcp);
  arm->moves_tcp.assign(static_cast<std::size_t>(n), 0);
  for (int j = tcp_joint; j >= 0; j = parents[j]) arm->moves_tcp[j] = 1;
  return arm;
}

py::array_t<double> tcp_poses(const Arm& arm, const Array& path) {
  const int count = rows_of(path, arm.dof(), "joints");
  py::array_t<double> poses({count, 4, 4});
  std::vector<Transform> frames(arm.joints.size());
  for (int i = 0; i < count; ++i) {
    arm.forward(path.data() + i * arm.dof(), frames.data());
    const py::array_t<double> pose = matrix_of(arm.tcp_pose(frames.data()));
    std::copy(pose.data(), pose.data() + 16, poses.mutable_data() + 16 * i);
  }
  return poses;
}

py::array_t<double> tcp_speeds(const Arm& arm, const Array& path, const Array& velocities) {
  const int n = arm.dof(), count = rows_of(path, n, "joints");
  if (rows_of(velocities, n, "velocities") != count) throw std::invalid_argument("one velocity per state");
  py::array_t<double> speeds({count, 2});
  std::vector<Transform> frames(arm.joints.size());
  std::vector<double> jacobian(6 * arm.joints.size());
  for (int i = 0; i < count; ++i) {
    arm.forward(path.data() + i * n, frames.data());
    arm.jacobian(frames.data(), arm.tcp_pose(frames.data()).t, jacobian.data());
    double rate[6] = {0, 0, 0, 0, 0, 0};
    for (int k = 0; k < 6; ++k)
      for (int j = 0; j < n; ++j) rate[k] += jacobian[k * n + j] * velocities.data()[i * n + j];
    speeds.mutable_data()[2 * i] = norm({rate[0], rate[1], rate[2]});
    speeds.mutable_data()[2 * i + 1] = norm({rate[3], rate[4], rate[5]});
  }
  return speeds;
}

py::array_t<double> rows(const std::vector<double>& flat, int width) {
  py::array_t<double> array({static_cast<py::ssize_t>(flat.size()) / width, static_cast<py::ssize_t>(width)});
  std::copy(flat.begin(), flat.end(), array.mutable_data());
  return array;
}

py::array_t<double> flat(const std::vector<double>& values) {
  return py::array_t<double>(static_cast<py::ssize_t>(values.size()), values.data());
}

const Margins& checked(const World& world, const Margins& margins) {
  if (!margins.pairs.empty() && static_cast<int>(margins.pairs.size()) != world.pairs()) {
    throw std::invalid_argument("expected a margin for each of " + std::to_string(world.pairs()) + " pairs");
  }
  return margins;
}

// Rows sorted by their distance from a reference (the largest over the joints). A row is dropped if it is within `same`
// of a kept row in every joint.
py::array_t<double> distinct(const Array& found, const Array& reference, double same) {
  const int n = static_cast<int>(reference.size()), count = rows_of(found, n, "solutions");
  const double *q = found.data(), *from = reference.data();
  const auto apart = [n](const double* a, const double* b) {
    double most = 0.0;
    for (int j = 0; j < n; ++j) most = std::max(most, std::abs(a[j] - b[j]));
    return most;
  };
  std::vector<int> order(static_cast<std::size_t>(count)), kept;
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(),
                   [&](int a, int b) { return apart(q + a * n, from) < apart(q + b * n, from); });
  std::vector<double> result;
  for (const int i : order) {
    const auto near = [&](int k) { return apart(q + i * n, q + k * n) <= same; };
    if (std::any_of(kept.begin(), kept.end(), near)) continue;
    kept.push_back(i);
    result.insert(result.end(), q + i * n, q + (i + 1) * n);
  }
  return rows(result, n);
}

// Homogeneous matrices (N, 4, 4) of poses (N, 7): position, quaternion xyzw.
py::array_t<double> pose_matrices(const Array& poses) {
  if (poses.ndim() != 2 || poses.shape(1) != 7) throw std::invalid_argument("expected rows of 7");
  const auto count = poses.shape(0);
  py::array_t<double> matrices({count, py::ssize_t{4}, py::ssize_t{4}});
  for (py::ssize_t i = 0; i < count; ++i) {
    const double* p = poses.data() + 7 * i;
    const double x = p[3], y = p[4], z = p[5], w = p[6], s = 2.0 / (x * x + y * y + z * z + w * w);
    const double values[16] = {1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w), p[0],
                               s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w), p[1],
                               s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y), p[2],
                               0.0, 0.0, 0.0, 1.0};
    std::copy(values, values + 16, matrices.mutable_data() + 16 * i);
  }
  return matrices;
}

// Least and largest value of each column, shape (2, n).
py::array_t<double> extremes(const Array& values) {
  if (values.ndim() != 2 || values.shape(0) < 1) throw std::invalid_argument("expected rows");
  const auto count = values.shape(0), n = values.shape(1);
  py::array_t<double> found({py::ssize_t{2}, n});
  double *low = found.mutable_data(), *high = low + n;
  std::copy(values.data(), values.data() + n, low);
  std::copy(values.data(), values.data() + n, high);
  for (py::ssize_t i = 1; i < count; ++i) {
    for (py::ssize_t j = 0; j < n; ++j) {
      const double value = values.data()[i * n + j];
      low[j] = value < low[j] ? value : low[j];
      high[j] = value > high[j] ? value : high[j];
    }
  }
  return found;
}

// Value and first three derivatives of a vector-valued piecewise polynomial. Coefficients have shape
// (order + 1, pieces, n), highest power first, in the time since the start of each piece.
py::array_t<double> sample_polynomial(const Array& breaks, const Array& coefficients, const Array& times) {
  if (coefficients.ndim() != 3 || breaks.size() != coefficients.shape(1) + 1 || coefficients.shape(1) < 1) {
    throw std::invalid_argument("coefficients have shape (order + 1, pieces, n), breaks one more entry than pieces");
  }
  const auto orders = coefficients.shape(0), pieces = coefficients.shape(1), n = coefficients.shape(2);
  const py::ssize_t count = times.size();
  py::array_t<double> samples({py::ssize_t{4}, count, n});
  double* out = samples.mutable_data();
  const double* begins = breaks.data();
  py::ssize_t piece = 0;
  for (py::ssize_t i = 0; i < count; ++i) {
    const double at = std::clamp(times.data()[i], begins[0], begins[pieces]);
    if (at < begins[piece] || at >= begins[piece + 1]) {
      piece = std::upper_bound(begins + 1, begins + pieces, at) - (begins + 1);
    }
    const double t = at - begins[piece];
    for (py::ssize_t j = 0; j < n; ++j) {
      double value[4] = {0.0, 0.0, 0.0, 0.0};  // Horner's scheme for the value and the derivatives divided by k!
      for (py::ssize_t k = 0; k < orders; ++k) {
        value[3] = value[3] * t + value[2];
        value[2] = value[2] * t + value[1];
        value[1] = value[1] * t + value[0];
        value[0] = value[0] * t + coefficients.data()[(k * pieces + piece) * n + j];
      }
      const double factor[4] = {1.0, 1.0, 2.0, 6.0};
      for (int d = 0; d < 4; ++d) out[(d * count + i) * n + j] = factor[d] * value[d];
    }
  }
  return samples;
}

py::tuple solve_ik(const Arm& arm, const Array& target, const Array& reference, std::uint64_t seed, int starts,
                   int enough, int iterations, double position_tolerance, double rotation_tolerance) {
  if (rows_of(reference, arm.dof(), "reference") != 1) throw std::invalid_argument("one reference");
  const IkSettings settings{position_tolerance, rotation_tolerance, iterations, starts, enough};
  const IkOutcome outcome = inverse_kinematics(arm, transform_of(target), reference.data(), seed, settings);
  return py::make_tuple(rows(outcome.solutions, arm.dof()), outcome.position_error, outcome.rotation_error);
}

Mat3 matrix_of_quaternion(const std::array<double, 4>& xyzw) {
  const auto [a, b, c, d] = xyzw;
  const double scale = 1.0 / std::sqrt(a * a + b * b + c * c + d * d);
  const double x = a * scale, y = b * scale, z = c * scale, w = d * scale;
  return {{1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), 2 * (x * y + z * w),
           1 - 2 * (x * x + z * z), 2 * (y * z - x * w), 2 * (x * z - y * w), 2 * (y * z + x * w),
           1 - 2 * (x * x + y * y)}};
}

// Joints as lists: from Python this is faster for an arm's few numbers than arrays.
py::tuple follow_target(const Arm& arm, const std::array<double, 3>& position, const std::array<double, 4>& quaternion,
                        const std::vector<double>& start, const std::vector<double>& pull,
                        const std::vector<double>& largest_change, int iterations, double position_tolerance,
                        double rotation_tolerance) {
  const std::size_t n = arm.joints.size();
  if (start.size() != n || (!pull.empty() && pull.size() != n) ||
      (!largest_change.empty() && largest_change.size() != n)) {
    throw std::invalid_argument("start, pull and largest_change have one number per joint");
  }
  std::vector<double> lower(n), upper(n);
  for (std::size_t j = 0; j < n; ++j) {
    lower[j] = arm.joints[j].lower, upper[j] = arm.joints[j].upper;
    if (!largest_change.empty()) {
      lower[j] = std::max(lower[j], start[j] - largest_change[j]);
      upper[j] = std::min(upper[j], start[j] + largest_change[j]);
      if (lower[j] > upper[j]) lower[j] = upper[j] = std::clamp(start[j], upper[j], lower[j]);
    }
  }
  const Transform target{matrix_of_quaternion(quaternion), {position[0], position[1], position[2]}};
  const FollowOutcome found = follow(arm, target, start.data(), lower.data(), upper.data(),
                                     pull.empty() ? nullptr : pull.data(),
                                     {position_tolerance, rotation_tolerance, iterations});
  return py::make_tuple(found.joints, found.position_error, found.rotation_error);
}

}  // namespace

PYBIND11_MODULE(_native, m) {
#if defined(__x86_64__) && defined(__AVX2__)
  __builtin_cpu_init();
  if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("fma")) {
    throw py::import_error("roboxim_planner_native is compiled for processors with AVX2 and FMA (x86-64-v3)");
  }
#endif
  m.attr("API") = 5;
  m.def("distinct", &distinct, py::arg("solutions"), py::arg("reference"), py::arg("same"));
  m.def("extremes", &extremes, py::arg("values"));
  m.def("pose_matrices", &pose_matrices, py::arg("poses"));
  m.def("sample_polynomial", &sample_polynomial, py::arg("breaks"), py::arg("coefficients"), py::arg("times"));

  py::class_<Arm, std::shared_ptr<Arm>>(m, "Arm")
      .def(py::init(&make_arm), py::kw_only(), py::arg("parents"), py::arg("placements"), py::arg("axes"),
           py::arg("prismatic"), py::arg("lower"), py::arg("upper"), py::arg("tcp_joint"), py::arg("tcp"))
      .def("tcp_poses", &tcp_poses, py::arg("joints"))
      .def("tcp_speeds", &tcp_speeds, py::arg("joints"), py::arg("velocities"))
      .def("follow", &follow_target, py::arg("position"), py::arg("quaternion"), py::arg("start"), py::kw_only(),
           py::arg("pull"), py::arg("largest_change"), py::arg("iterations"), py::arg("position_tolerance"),
           py::arg("rotation_tolerance"))
      .def("ik", &solve_ik, py::arg("target"), py::arg("reference"), py::kw_only(), py::arg("seed"),
           py::arg("starts"), py::arg("enough"), py::arg("iterations"), py::arg("position_tolerance"),
           py::arg("rotation_tolerance"));

  py::class_<Item, std::shared_ptr<Item>>(m, "Item")
      .def(py::init([](int joint, const std::string& kind, const Array& size, const Array& pose, const Array& spheres) {
             const int count = rows_of(spheres, 4, "spheres");
             return std::const_pointer_cast<Item>(make_item(joint, shape_of(kind, size), transform_of(pose),
                                                            spheres.data(), static_cast<std::size_t>(count)));
           }),
           py::arg("joint"), py::arg("kind"), py::arg("size"), py::arg("pose"), py::arg("spheres"));

  py::class_<Mesh, std::shared_ptr<Mesh>>(m, "Mesh").def(
      py::init([](const Array& corners) {
        if (corners.ndim() != 3 || corners.shape(1) != 3 || corners.shape(2) != 3) {
          throw std::invalid_argument("a mesh's corners have shape (N, 3, 3)");
        }
        return std::const_pointer_cast<Mesh>(make_mesh(corners.data(), static_cast<std::size_t>(corners.shape(0))));
      }),
      py::arg("corners"));

  py::class_<Obstacle>(m, "Obstacle")
      .def(py::init([](const std::string& kind, const Array& size, const Array& pose) {
             return Obstacle{{shape_of(kind, size), transform_of(pose)}, nullptr};
           }),
           py::arg("kind"), py::arg("size"), py::arg("pose"))
      .def(py::init([](std::shared_ptr<Mesh> mesh, const Array& pose) {
             return Obstacle{{Shape{}, transform_of(pose)}, std::move(mesh)};
           }),
           py::arg("mesh"), py::arg("pose"));

  py::class_<Margins>(m, "Margins")
      .def(py::init([](double margin, double self_margin, double resolution) {
             return Margins{margin, self_margin, resolution, {}};
           }),
           py::arg("margin"), py::arg("self_margin"), py::arg("resolution"))
      .def(py::init([](const Array& pairs, double resolution) {
             return Margins{0.0, 0.0, resolution, std::vector<float>(pairs.data(), pairs.data() + pairs.size())};
           }),
           py::arg("pairs"), py::arg("resolution"));

  py::class_<World>(m, "World")
      .def(py::init([](std::shared_ptr<Arm> arm, const std::vector<std::shared_ptr<Item>>& items,
                       const std::vector<Obstacle>& obstacles, const std::vector<int>& item_pairs,
                       const std::vector<int>& obstacle_pairs) {
             return std::make_unique<World>(std::move(arm),
                                            std::vector<std::shared_ptr<const Item>>(items.begin(), items.end()),
                                            obstacles, item_pairs, obstacle_pairs);
           }),
           py::arg("arm"), py::arg("items"), py::arg("obstacles"), py::arg("item_pairs"), py::arg("obstacle_pairs"))
      .def(
          "set_upright",
          [](World& world, const Array& axis, const Array& direction, double tolerance) {
            world.upright = {true, vector_of(axis), vector_of(direction), tolerance};
          },
          py::arg("axis"), py::arg("direction"), py::arg("tolerance"))
      .def(
          "path_is_free",
          [](World& world, const Array& path, const Margins& margins) {
            const int count = rows_of(path, world.arm().dof(), "path");
            return world.path_is_free(path.data(), count, checked(world, margins));
          },
          py::arg("path"), py::arg("margins"))
      .def(
          "free_states",
          [](World& world, const Array& states, const Margins& margins) {
            const int n = world.arm().dof(), count = rows_of(states, n, "states");
            py::array_t<bool> free(count);
            for (int i = 0; i < count; ++i) {
              free.mutable_data()[i] = world.path_is_free(states.data() + i * n, 1, checked(world, margins));
            }
            return free;
          },
          py::arg("states"), py::arg("margins"))
      .def(
          "free_edge",
          [](World& world, const Array& start, const Array& ends, const Margins& margins) {
            const int n = world.arm().dof(), count = rows_of(ends, n, "ends");
            rows_of(start, n, "start");
            std::vector<double> edge(start.data(), start.data() + n);
            for (int i = 0; i < count; ++i) {
              edge.resize(n);
              edge.insert(edge.end(), ends.data() + i * n, ends.data() + (i + 1) * n);
              if (world.path_is_free(edge.data(), 2, checked(world, margins))) return i;
            }
            return -1;
          },
          py::arg("start"), py::arg("ends"), py::arg("margins"))
      .def(
          "first_hit",
          [](World& world, const Array& path, const Margins& margins) {
            const int count = rows_of(path, world.arm().dof(), "path");
            return world.first_hit(path.data(), count, checked(world, margins));
          },
          py::arg("path"), py::arg("margins"))
      .def(
          "shorten",
          [](World& world, const Array& path, std::uint64_t seed, int tries, const Array& weights,
             const Margins& margins) {
            const int count = rows_of(path, world.arm().dof(), "path");
            rows_of(weights, world.arm().dof(), "weights");
            return rows(world.shorten(path.data(), count, seed, tries, checked(world, margins), weights.data()),
                        world.arm().dof());
          },
          py::arg("path"), py::arg("seed"), py::arg("tries"), py::arg("weights"), py::arg("margins"))
      .def(
          "blends",
          [](World& world, const Array& path, double largest, int halvings, const Margins& margins) {
            const int count = rows_of(path, world.arm().dof(), "path");
            return flat(world.blends(path.data(), count, largest, halvings, checked(world, margins)));
          },
          py::arg("path"), py::arg("largest"), py::arg("halvings"), py::arg("margins"))
      .def(
          "connect_upright",
          [](World& world, const Array& start, const Array& goals, std::uint64_t seed, int iterations, double step,
             const Margins& margins, const std::function<void(int)>& watch) {
            const int n = world.arm().dof(), count = rows_of(goals, n, "goals");
            rows_of(start, n, "start");
            return rows(world.connect_upright(start.data(), goals.data(), count, seed, iterations, step,
                                              checked(world, margins), watch),
                        n);
          },
          py::arg("start"), py::arg("goals"), py::arg("seed"), py::arg("iterations"), py::arg("step"),
          py::arg("margins"), py::arg("watch"))
      .def(
          "tilt",
          [](World& world, const Array& joints) {
            rows_of(joints, world.arm().dof(), "joints");
            return world.tilt(joints.data());
          },
          py::arg("joints"))
      .def(
          "clearance",
          [](World& world, const Array& joints, double cap) {
            rows_of(joints, world.arm().dof(), "joints");
            return world.clearance(joints.data(), cap);
          },
          py::arg("joints"), py::arg("cap"))
      .def(
          "clearances",
          [](World& world, const Array& states, double cap) {
            const int count = rows_of(states, world.arm().dof(), "states");
            return flat(world.clearances(states.data(), count, cap));
          },
          py::arg("states"), py::arg("cap"))
      .def_readonly("states_checked", &World::states_checked);
}
