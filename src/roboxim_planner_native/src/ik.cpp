#include <limits>

#include "arm.hpp"

namespace roboxim {
namespace {

constexpr int kNear = 2;          // number of starts in the neighbourhood of the reference
constexpr int kDraws = 6;         // draws per start; the nearest to the target is used, which saves failing descents
constexpr double kNearRad = 0.5;  // half width of the neighbourhood
constexpr int kStall = 5;  // iterations in which the error must halve
constexpr double kTurn = 0.3;
constexpr double kLongestStep = 0.6;

Vec3 rotation_error(const Mat3& goal, const Mat3& now) {
  Mat3 back;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) back.m[3 * i + j] = now.m[3 * j + i];
  const Mat3 r = goal * back;
  const Vec3 axis = {0.5 * (r.m[7] - r.m[5]), 0.5 * (r.m[2] - r.m[6]), 0.5 * (r.m[3] - r.m[1])};
  const double sine = norm(axis), angle = std::atan2(sine, 0.5 * (r.m[0] + r.m[4] + r.m[8] - 1.0));
  if (sine > 1e-9) return (angle / sine) * axis;
  return angle > 3.0 ? Vec3{3.141592653589793, 0.0, 0.0} : axis;
}

// The symmetric positive definite matrix of six becomes its Cholesky factor.
void factor_six(double* a) {
  for (int i = 0; i < 6; ++i) {
    for (int j = 0; j <= i; ++j) {
      double sum = a[6 * i + j];
      for (int k = 0; k < j; ++k) sum -= a[6 * i + k] * a[6 * j + k];
      a[6 * i + j] = i == j ? std::sqrt(std::max(sum, 1e-30)) : sum / a[6 * j + j];
    }
  }
}

// Solves in place with a factor.
void substitute_six(const double* a, double* b) {
  for (int i = 0; i < 6; ++i) {
    for (int k = 0; k < i; ++k) b[i] -= a[6 * i + k] * b[k];
    b[i] /= a[6 * i + i];
  }
  for (int i = 5; i >= 0; --i) {
    for (int k = i + 1; k < 6; ++k) b[i] -= a[6 * k + i] * b[k];
    b[i] /= a[6 * i + i];
  }
}

void solve_six(double* a, double* b) {
  factor_six(a);
  substitute_six(a, b);
}

struct Descent {
  const Arm& arm;
  const Transform& target;
  const IkSettings& settings;
  std::vector<Transform> frames;
  std::vector<double> jacobian;
  double best_position = 1e300, best_rotation = 1e300;

  Descent(const Arm& a, const Transform& t, const IkSettings& s)
      : arm(a), target(t), settings(s), frames(a.joints.size()), jacobian(6 * a.joints.size()) {}

  // Distance of a state from the target [m]; one radian counts as kTurn metres.
  double apart(const double* q) {
    arm.forward(q, frames.data());
    const Transform tcp = arm.tcp_pose(frames.data());
    return norm(target.t - tcp.t) + kTurn * norm(rotation_error(target.r, tcp.r));
  }

  // Damping falls with the error (Sugihara, IEEE T-RO 2011). A joint that a step would push beyond a limit stays at it.
  bool run(double* q) {
    const int n = arm.dof();
    double recent = 1e300;
    for (int turn = 0; turn < settings.iterations; ++turn) {
      arm.forward(q, frames.data());
      const Transform tcp = arm.tcp_pose(frames.data());
      const Vec3 off = target.t - tcp.t, turned = rotation_error(target.r, tcp.r);
      const double far = norm(off), angle = norm(turned);
      if (far + 0.1 * angle < best_position + 0.1 * best_rotation) best_position = far, best_rotation = angle;
      if (far <= settings.position_tolerance && angle <= settings.rotation_tolerance) return true;
      if (turn % kStall == kStall - 1) {  // give up a descent that stalls
        if (far + 0.1 * angle > 0.5 * recent) return false;
        recent = far + 0.1 * angle;
      }
      arm.jacobian(frames.data(), tcp.t, jacobian.data());
      const double error[6] = {off.x, off.y, off.z, turned.x, turned.y, turned.z};
      step(error, q, n);
    }
    return false;
  }

 private:
  void step(const double* error, double* q, int n) {
    double damping = 1e-7;
    for (int i = 0; i < 6; ++i) damping += 0.5 * error[i] * error[i];
    std::uint64_t resting = 0;
    for (int pass = 0; pass < 2; ++pass) {
      double change[64];
      solve(error, damping, resting, change, n);
      std::uint64_t blocked = 0;
      for (int j = 0; j < n; ++j) {
        const Joint& joint = arm.joints[j];
        const bool out = (q[j] <= joint.lower && change[j] < 0.0) || (q[j] >= joint.upper && change[j] > 0.0);
        if (out) blocked |= 1ULL << j;
      }
      if (pass == 0 && blocked) {
        resting = blocked;
        continue;
      }
      double largest = 1e-12;
      for (int j = 0; j < n; ++j) largest = std::max(largest, std::abs(change[j]));
      const double scale = std::min(1.0, kLongestStep / largest);
      for (int j = 0; j < n; ++j) {
        q[j] = std::clamp(q[j] + scale * change[j], arm.joints[j].lower, arm.joints[j].upper);
      }
      return;
    }
  }

  void solve(const double* error, double damping, std::uint64_t resting, double* change, int n) const {
    const int width = (n + 3) / 4 * 4;
    alignas(32) double active[6 * 64];
    std::fill(active, active + 6 * width, 0.0);
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < n; ++j)
        if (!(resting >> j & 1)) active[i * width + j] = jacobian[i * n + j];
    double normal[36], y[6];
    for (int i = 0; i < 6; ++i) {
      y[i] = error[i];
      for (int k = 0; k <= i; ++k) {
        Quad sum{};
        for (int j = 0; j < width; j += 4) {
          Quad a, b;
          __builtin_memcpy(&a, active + i * width + j, sizeof a);
          __builtin_memcpy(&b, active + k * width + j, sizeof b);
          sum += a * b;
        }
        normal[6 * i + k] = sum[0] + sum[1] + sum[2] + sum[3] + (i == k ? damping : 0.0);
      }
    }
    solve_six(normal, y);
    for (int j = 0; j < n; ++j) {
      change[j] = 0.0;
      for (int i = 0; i < 6; ++i) change[j] += active[i * width + j] * y[i];
    }
  }
};

constexpr double kFollowTurn = 0.3;    // metres that a radian of error counts as
constexpr double kFollowStep = 0.3;    // largest change of a joint in an iteration [rad or m]

// One damped step; joints that a bound stops are left out, and the others solve again.
void follow_step(const double* jacobian, int n, const double* error, const double* q, const double* lower,
                 const double* upper, const double* pull, double* step) {
  double damping = 0.0;
  for (int i = 0; i < 6; ++i) damping += error[i] * error[i];
  damping = 1e-8 + 1e-3 * std::min(damping, 1.0);
  std::uint64_t resting = 0;
  for (int pass = 0; pass < 3; ++pass) {
    double active[6 * 64], normal[36], y[6], pulled[6];
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < n; ++j) active[i * n + j] = (resting >> j & 1) ? 0.0 : jacobian[i * n + j];
    for (int i = 0; i < 6; ++i) {
      for (int k = 0; k <= i; ++k) {
        double sum = i == k ? damping : 0.0;
        for (int j = 0; j < n; ++j) sum += active[i * n + j] * active[k * n + j];
        normal[6 * i + k] = sum;
      }
      y[i] = error[i];
      pulled[i] = 0.0;
      if (pull)
        for (int j = 0; j < n; ++j) pulled[i] += active[i * n + j] * pull[j];
    }
    factor_six(normal);
    substitute_six(normal, y);
    if (pull) substitute_six(normal, pulled);
    std::uint64_t stopped = 0;
    for (int j = 0; j < n; ++j) {
      step[j] = 0.0;
      if (resting >> j & 1) continue;
      for (int i = 0; i < 6; ++i) step[j] += active[i * n + j] * (pull ? y[i] - pulled[i] : y[i]);
      if (pull) step[j] += pull[j];
      if ((q[j] <= lower[j] && step[j] < 0.0) || (q[j] >= upper[j] && step[j] > 0.0)) stopped |= 1ULL << j;
    }
    if (!stopped) break;
    resting |= stopped;
    for (int j = 0; j < n; ++j)
      if (resting >> j & 1) step[j] = 0.0;
  }
  for (int j = 0; j < n; ++j) step[j] = std::clamp(step[j], -kFollowStep, kFollowStep);
}

}  // namespace

FollowOutcome follow(const Arm& arm, const Transform& target, const double* start, const double* lower,
                     const double* upper, const double* pull, const FollowSettings& settings) {
  const int n = arm.dof();
  std::vector<Transform> frames(arm.joints.size());
  std::vector<double> jacobian(6 * arm.joints.size()), q(arm.joints.size()), step(arm.joints.size());
  FollowOutcome best;
  double best_cost = 1e300;
  for (int j = 0; j < n; ++j) q[j] = std::clamp(start[j], lower[j], upper[j]);
  for (int turn = 0; turn < settings.iterations; ++turn) {
    arm.forward(q.data(), frames.data());
    const Transform tcp = arm.tcp_pose(frames.data());
    const Vec3 off = target.t - tcp.t, turned = rotation_error(target.r, tcp.r);
    const double far = norm(off), angle = norm(turned);
    if (far + kFollowTurn * angle < best_cost) {
      best_cost = far + kFollowTurn * angle;
      best = {q, far, angle};
    }
    if (!pull && far < settings.position_tolerance && angle < settings.rotation_tolerance) break;
    arm.jacobian(frames.data(), tcp.t, jacobian.data());
    const double error[6] = {off.x, off.y, off.z, turned.x, turned.y, turned.z};
    follow_step(jacobian.data(), n, error, q.data(), lower, upper, pull, step.data());
    for (int j = 0; j < n; ++j) q[j] = std::clamp(q[j] + step[j], lower[j], upper[j]);
    if (pull) pull = nullptr, best_cost = 1e300;  // once is enough; the other iterations correct what it disturbs
  }
  return best;
}

IkOutcome inverse_kinematics(const Arm& arm, const Transform& target, const double* reference, std::uint64_t seed,
                             const IkSettings& settings) {
  const int n = arm.dof();
  Random random{seed * 0x9e3779b97f4a7c15ULL + 0x632be59bd9b4e019ULL};
  Descent descent(arm, target, settings);
  IkOutcome outcome;
  std::vector<double> q(static_cast<std::size_t>(n));
  int found = 0;
  std::vector<double> drawn(q.size());
  for (int start = 0; start < settings.starts && found < settings.enough; ++start) {
    double best = 1e300;
    for (int draw = 0; draw < (start <= kNear ? 1 : kDraws); ++draw) {
      for (int j = 0; j < n; ++j) {
        const Joint& joint = arm.joints[j];
        const double part = start == 0 ? 0.0 : random.uniform();
        drawn[j] = start <= kNear ? reference[j] + (start > 0) * kNearRad * (2.0 * part - 1.0)
                                  : joint.lower + part * (joint.upper - joint.lower);
        drawn[j] = std::clamp(drawn[j], joint.lower, joint.upper);
      }
      const double apart = start <= kNear ? 0.0 : descent.apart(drawn.data());
      if (apart < best) best = apart, q = drawn;
    }
    if (descent.run(q.data())) {
      outcome.solutions.insert(outcome.solutions.end(), q.begin(), q.end());
      ++found;
    }
  }
  outcome.position_error = descent.best_position;
  outcome.rotation_error = descent.best_rotation;
  return outcome;
}

}  // namespace roboxim
