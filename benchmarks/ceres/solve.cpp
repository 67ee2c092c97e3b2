// Laser-spot calibration with Ceres and automatic differentiation: the comparator of the speed runs.
//
//   solve[_plain] PROBLEM [--solver NAME] [--tolerance T] [--iterations I] [--repeats N]
//
// PROBLEM is a stream of native float64 (written by ceres_problem.py):
//   N, P, R_base_camera (9, row-major), t_base_camera (3), intrinsics (9: fu fv skew u0 v0 k1 k2 p1 p2),
//   beam frame R0 (9), t0 (3), beam (4: a b x y), P x (normal (3), its basis (6: e1, e2), distance),
//   N x (u, v, R_base_hand (9), t_base_hand (3), plane index).
// Metres, radians, pixels. The answer goes to standard output as JSON.
#include <ceres/ceres.h>
#include <ceres/rotation.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <memory>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

namespace {

using Vector3 = std::array<double, 3>;
using Matrix3 = std::array<double, 9>;  // row-major

struct Plane {
  Vector3 normal, e1, e2;  // of the start; the estimate is normal + a0 e1 + a1 e2, and distance
};

struct Spot {
  double u, v;
  Matrix3 R_base_hand;
  Vector3 t_base_hand;
  int plane;
};

// Everything that is estimated, in the order of the output.
struct State {
  std::array<double, 6> camera;  // angle-axis and translation of camera from base
  std::array<double, 9> intrinsics;
  std::array<double, 4> beam;
  std::vector<std::array<double, 3>> planes;  // a0, a1, distance
};

struct Data {
  State start;
  Matrix3 R_hand_beam;
  Vector3 t_hand_beam;
  std::vector<Plane> planes;
  std::vector<Spot> spots;
};

class Reader {
 public:
  explicit Reader(const std::string& path) : file_(path, std::ios::binary) {
    if (!file_) throw std::runtime_error("cannot open " + path);
  }
  double number() {
    double value;
    if (!file_.read(reinterpret_cast<char*>(&value), sizeof value))
      throw std::runtime_error("the problem file is too short");
    return value;
  }
  template <std::size_t n>
  std::array<double, n> array() {
    std::array<double, n> values;
    for (double& value : values) value = number();
    return values;
  }

 private:
  std::ifstream file_;
};

Vector3 operator*(const Matrix3& R, const Vector3& v) {
  Vector3 out;
  for (int i = 0; i < 3; ++i) out[i] = R[3 * i] * v[0] + R[3 * i + 1] * v[1] + R[3 * i + 2] * v[2];
  return out;
}

Matrix3 operator*(const Matrix3& A, const Matrix3& B) {
  Matrix3 out{};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      for (int k = 0; k < 3; ++k) out[3 * i + j] += A[3 * i + k] * B[3 * k + j];
  return out;
}

Data read(const std::string& path) {
  Reader in(path);
  Data data;
  const auto n_spots = static_cast<std::size_t>(in.number());
  const auto n_planes = static_cast<std::size_t>(in.number());
  // read row-major, taken as column-major: the transpose, camera from base
  const Matrix3 R_base_camera = in.array<9>();
  const Vector3 t_base_camera = in.array<3>();
  ceres::RotationMatrixToAngleAxis(R_base_camera.data(), data.start.camera.data());
  double t[3];
  ceres::AngleAxisRotatePoint(data.start.camera.data(), t_base_camera.data(), t);
  for (int i = 0; i < 3; ++i) data.start.camera[3 + i] = -t[i];
  data.start.intrinsics = in.array<9>();
  data.R_hand_beam = in.array<9>();
  data.t_hand_beam = in.array<3>();
  data.start.beam = in.array<4>();
  for (std::size_t p = 0; p < n_planes; ++p) {
    Plane plane;
    plane.normal = in.array<3>();
    plane.e1 = in.array<3>();
    plane.e2 = in.array<3>();
    data.planes.push_back(plane);
    data.start.planes.push_back({0.0, 0.0, in.number()});
  }
  for (std::size_t k = 0; k < n_spots; ++k) {
    Spot spot;
    spot.u = in.number();
    spot.v = in.number();
    spot.R_base_hand = in.array<9>();
    spot.t_base_hand = in.array<3>();
    spot.plane = static_cast<int>(in.number());
    if (spot.plane < 0 || spot.plane >= static_cast<int>(n_planes))
      throw std::runtime_error("plane index out of range");
    data.spots.push_back(spot);
  }
  return data;
}

// Predicted minus seen pixel of one spot.
class SpotError {
 public:
  SpotError(const Data& data, const Spot& spot)
      : plane_(data.planes[spot.plane]),
        R_(spot.R_base_hand * data.R_hand_beam),
        t_(spot.R_base_hand * data.t_hand_beam),
        u_(spot.u),
        v_(spot.v) {
    for (int i = 0; i < 3; ++i) t_[i] += spot.t_base_hand[i];
  }

  // The arguments end with the residual; before it may come a block of padding.
  template <typename T, typename... Tail>
  bool operator()(const T* camera, const T* intrinsics, const T* beam, const T* plane,
                  Tail... tail) const {
    T* const residual = std::get<sizeof...(Tail) - 1>(std::make_tuple(tail...));
    T direction[3], point[3], normal[3], spot[3], p[3];
    for (int i = 0; i < 3; ++i) {
      direction[i] = R_[3 * i] * beam[0] + R_[3 * i + 1] * beam[1] + R_[3 * i + 2];
      point[i] = R_[3 * i] * beam[2] + R_[3 * i + 1] * beam[3] + t_[i];
      normal[i] = plane_.e1[i] * plane[0] + plane_.e2[i] * plane[1] + plane_.normal[i];
    }
    const T length = (plane[2] - ceres::DotProduct(normal, point)) /
                     ceres::DotProduct(normal, direction);
    for (int i = 0; i < 3; ++i) spot[i] = point[i] + length * direction[i];

    ceres::AngleAxisRotatePoint(camera, spot, p);
    const T depth = p[2] + camera[5];
    if (!(depth > 0.0)) return false;
    const T inverse = 1.0 / depth;
    const T x = (p[0] + camera[3]) * inverse;
    const T y = (p[1] + camera[4]) * inverse;

    const T& k1 = intrinsics[5];
    const T& k2 = intrinsics[6];
    const T& p1 = intrinsics[7];
    const T& p2 = intrinsics[8];
    const T xx = x * x, yy = y * y, xy2 = 2.0 * x * y, rr = xx + yy;
    const T radial = 1.0 + rr * (k1 + rr * k2);
    const T xd = x * radial + p1 * xy2 + p2 * (rr + 2.0 * xx);
    const T yd = y * radial + p1 * (rr + 2.0 * yy) + p2 * xy2;
    residual[0] = intrinsics[0] * xd + intrinsics[2] * yd + intrinsics[3] - u_;
    residual[1] = intrinsics[1] * yd + intrinsics[4] - v_;
    return true;
  }

 private:
  Plane plane_;
  Matrix3 R_;  // beam frame in base
  Vector3 t_;
  double u_, v_;
};

// Eigen fills wide registers only where their length divides that of the Jet: a constant block of
// two makes 22 derivatives 24 and the solve about twice as fast. Both forms in one program would cost
// the compiler's willingness to inline, hence two programs.
#ifdef PLAIN_JETS
constexpr bool padded = false;
using Cost = ceres::AutoDiffCostFunction<SpotError, 2, 6, 9, 4, 3>;
#else
constexpr bool padded = true;
using Cost = ceres::AutoDiffCostFunction<SpotError, 2, 6, 9, 4, 3, 2>;
#endif

struct Arguments {
  std::string path;
  std::string solver = "DENSE_NORMAL_CHOLESKY";
  double tolerance = 1e-12;
  int iterations = 100;
  int repeats = 1;
};

Arguments parse(int argc, char** argv) {
  if (argc < 2 || argc % 2 != 0)
    throw std::runtime_error("usage: solve PROBLEM [--option value ...]");
  Arguments arguments;
  arguments.path = argv[1];
  for (int i = 2; i < argc; i += 2) {
    const std::string name = argv[i], value = argv[i + 1];
    if (name == "--solver") arguments.solver = value;
    else if (name == "--tolerance") arguments.tolerance = std::stod(value);
    else if (name == "--iterations") arguments.iterations = std::stoi(value);
    else if (name == "--repeats") arguments.repeats = std::stoi(value);
    else throw std::runtime_error("unknown option " + name);
  }
  return arguments;
}

ceres::Solver::Options options_for(const Arguments& arguments) {
  ceres::Solver::Options options;
  if (!ceres::StringToLinearSolverType(arguments.solver, &options.linear_solver_type))
    throw std::runtime_error("unknown solver " + arguments.solver);
  options.num_threads = 1;
  options.max_num_iterations = arguments.iterations;
  options.function_tolerance = arguments.tolerance;
  options.gradient_tolerance = arguments.tolerance;
  options.parameter_tolerance = arguments.tolerance;
  options.logging_type = ceres::SILENT;
  return options;
}

struct Run {
  State state;
  double solve_seconds, total_seconds;  // the total adds building and freeing the problem
  ceres::Solver::Summary summary;
};

Run run(const Data& data, const ceres::Solver::Options& base) {
  using Clock = std::chrono::steady_clock;
  using Seconds = std::chrono::duration<double>;
  Run result;
  result.state = data.start;
  State& state = result.state;
  const auto begin = Clock::now();
  {
    ceres::Problem problem;
    double padding[2] = {};
    if (padded) {
      problem.AddParameterBlock(padding, 2);
      problem.SetParameterBlockConstant(padding);
    }
    for (const Spot& spot : data.spots) {
      std::vector<double*> blocks = {state.camera.data(), state.intrinsics.data(),
                                     state.beam.data(), state.planes[spot.plane].data()};
      if (padded) blocks.push_back(padding);
      problem.AddResidualBlock(new Cost(new SpotError(data, spot)), nullptr, blocks);
    }
    ceres::Solver::Options options = base;
    if (ceres::IsSchurType(options.linear_solver_type)) {
      // no two planes share a spot, so they can be eliminated first
      options.linear_solver_ordering = std::make_shared<ceres::ParameterBlockOrdering>();
      for (auto& plane : state.planes)
        options.linear_solver_ordering->AddElementToGroup(plane.data(), 0);
      for (double* block : {state.camera.data(), state.intrinsics.data(), state.beam.data()})
        options.linear_solver_ordering->AddElementToGroup(block, 1);
      if (padded) options.linear_solver_ordering->AddElementToGroup(padding, 1);
    }
    const auto built = Clock::now();
    ceres::Solve(options, &problem, &result.summary);
    result.solve_seconds = Seconds(Clock::now() - built).count();
  }
  result.total_seconds = Seconds(Clock::now() - begin).count();
  return result;
}

double median(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  const std::size_t half = values.size() / 2;
  return values.size() % 2 ? values[half] : 0.5 * (values[half - 1] + values[half]);
}

template <typename Numbers>
void print(const char* name, const Numbers& values) {
  std::printf(", \"%s\": [", name);
  const char* comma = "";
  for (const double value : values) {
    std::printf("%s%.17g", comma, value);
    comma = ", ";
  }
  std::printf("]");
}

void report(const Data& data, const Run& last, const std::vector<double>& solve,
            const std::vector<double>& total) {
  const State& state = last.state;
  Matrix3 R_base_camera;  // column-major camera from base is row-major base from camera
  ceres::AngleAxisToRotationMatrix(state.camera.data(), R_base_camera.data());
  const Vector3 t_camera_base = {state.camera[3], state.camera[4], state.camera[5]};
  Vector3 t_base_camera = R_base_camera * t_camera_base;
  for (double& x : t_base_camera) x = -x;
  std::vector<double> planes;  // unit normal and distance
  for (std::size_t p = 0; p < data.planes.size(); ++p) {
    Vector3 n = data.planes[p].normal;
    for (int i = 0; i < 3; ++i)
      n[i] += data.planes[p].e1[i] * state.planes[p][0] + data.planes[p].e2[i] * state.planes[p][1];
    const double norm = std::sqrt(ceres::DotProduct(n.data(), n.data()));
    for (const double x : n) planes.push_back(x / norm);
    planes.push_back(state.planes[p][2] / norm);
  }
  std::printf("{\"solve_min\": %.9g, \"solve_median\": %.9g, \"total_min\": %.9g, "
              "\"total_median\": %.9g, \"iterations\": %zu, \"converged\": %s, "
              "\"initial_cost\": %.17g, \"final_cost\": %.17g",
              *std::min_element(solve.begin(), solve.end()), median(solve),
              *std::min_element(total.begin(), total.end()), median(total),
              last.summary.iterations.size() - 1,
              last.summary.termination_type == ceres::CONVERGENCE ? "true" : "false",
              last.summary.initial_cost, last.summary.final_cost);
  print("R_base_camera", R_base_camera);
  print("t_base_camera", t_base_camera);
  print("intrinsics", state.intrinsics);
  print("beam", state.beam);
  print("planes", planes);
  std::printf("}\n");
}

}  // namespace

int main(int argc, char** argv) {
  try {
    const Arguments arguments = parse(argc, argv);
    const Data data = read(arguments.path);
    const ceres::Solver::Options options = options_for(arguments);
    Run last = run(data, options);  // the first run warms caches and is not counted
    std::vector<double> solve, total;
    for (int i = 0; i < arguments.repeats; ++i) {
      last = run(data, options);
      solve.push_back(last.solve_seconds);
      total.push_back(last.total_seconds);
    }
    report(data, last, solve, total);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "solve: %s\n", error.what());
    return 1;
  }
  return 0;
}
