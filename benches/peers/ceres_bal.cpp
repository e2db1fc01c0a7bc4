// Bundle adjustment with Ceres, for comparison: BAL text in, one line of JSON out.
//
// Cost = 1/2 sum rho(|r|^2) over observations, r = f (1 + k1 |p|^2 + k2 |p|^4) p - measured, in pixels,
// with p = -(P.x, P.y) / P.z and P = R X + t; rho(s) = s, or Huber's `2 a sqrt(s) - a^2` where
// s > a^2. Derivatives are written out, which is faster than Ceres' automatic ones. With w the
// rotation vector and q = R X: dq/dw = -[q]x Jl(w), Jl the left Jacobian of SO(3).
//
// Points are eliminated first; what is left is solved dense, sparse or by conjugate gradients.
//
// Build (compare.py does): g++ -O3 -march=native -DEIGEN_MAX_ALIGN_BYTES=16 ceres_bal.cpp
// -lceres -lglog. The alignment is that of Debian's library, which is built for any x86-64.
//
// Reference: http://ceres-solver.org/nnls_solving.html, "Bundle adjustment in the large", ECCV 2010.

#include <ceres/ceres.h>
#include <glog/logging.h>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

namespace {

using Clock = std::chrono::steady_clock;

double since(Clock::time_point begin) {
  return std::chrono::duration<double>(Clock::now() - begin).count();
}

class Reprojection final : public ceres::SizedCostFunction<2, 9, 3> {
 public:
  Reprojection(double u, double v) : u_(u), v_(v) {}

  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override {
    const double* c = parameters[0];
    const double* x = parameters[1];
    const double w0 = c[0], w1 = c[1], w2 = c[2];
    const double theta2 = w0 * w0 + w1 * w1 + w2 * w2;
    // R = I + a [w]x + b [w]x^2, Jl = I + b [w]x + d [w]x^2
    double a, b, d;
    if (theta2 > 1e-8) {
      const double theta = std::sqrt(theta2);
      const double half = std::sin(0.5 * theta);
      a = std::sin(theta) / theta;
      b = 2.0 * half * half / theta2;
      d = (1.0 - a) / theta2;
    } else {
      a = 1.0 - theta2 / 6.0;
      b = 0.5 - theta2 / 24.0;
      d = 1.0 / 6.0 - theta2 / 120.0;
    }
    // [w]x^2 = w w^T - theta2 I
    const double cos = 1.0 - b * theta2;
    const double R[3][3] = {{cos + b * w0 * w0, b * w0 * w1 - a * w2, b * w0 * w2 + a * w1},
                            {b * w0 * w1 + a * w2, cos + b * w1 * w1, b * w1 * w2 - a * w0},
                            {b * w0 * w2 - a * w1, b * w1 * w2 + a * w0, cos + b * w2 * w2}};
    const double q0 = R[0][0] * x[0] + R[0][1] * x[1] + R[0][2] * x[2];
    const double q1 = R[1][0] * x[0] + R[1][1] * x[1] + R[1][2] * x[2];
    const double q2 = R[2][0] * x[0] + R[2][1] * x[1] + R[2][2] * x[2];
    const double P0 = q0 + c[3], P1 = q1 + c[4], P2 = q2 + c[5];
    const double inverse = -1.0 / P2;
    const double p0 = P0 * inverse, p1 = P1 * inverse;
    const double f = c[6], k1 = c[7], k2 = c[8];
    const double r2 = p0 * p0 + p1 * p1;
    const double distortion = 1.0 + r2 * (k1 + k2 * r2);
    residuals[0] = f * distortion * p0 - u_;
    residuals[1] = f * distortion * p1 - v_;
    if (jacobians == nullptr) return true;

    // dr/dp = f (distortion I + slope p p^T), dp/dP = inverse [I | p]
    const double slope = 2.0 * (k1 + 2.0 * k2 * r2);
    const double m00 = f * (distortion + slope * p0 * p0) * inverse;
    const double m01 = f * slope * p0 * p1 * inverse;
    const double m11 = f * (distortion + slope * p1 * p1) * inverse;
    const double M[2][3] = {{m00, m01, m00 * p0 + m01 * p1}, {m01, m11, m01 * p0 + m11 * p1}};
    if (jacobians[0] != nullptr) {
      const double diagonal = 1.0 - d * theta2;
      const double L[3][3] = {
          {diagonal + d * w0 * w0, d * w0 * w1 - b * w2, d * w0 * w2 + b * w1},
          {d * w0 * w1 + b * w2, diagonal + d * w1 * w1, d * w1 * w2 - b * w0},
          {d * w0 * w2 - b * w1, d * w1 * w2 + b * w0, diagonal + d * w2 * w2}};
      for (int row = 0; row < 2; ++row) {
        double* J = jacobians[0] + 9 * row;
        // m^T (-[q]x) = (q x m)^T
        const double n0 = q1 * M[row][2] - q2 * M[row][1];
        const double n1 = q2 * M[row][0] - q0 * M[row][2];
        const double n2 = q0 * M[row][1] - q1 * M[row][0];
        for (int k = 0; k < 3; ++k) {
          J[k] = n0 * L[0][k] + n1 * L[1][k] + n2 * L[2][k];
          J[3 + k] = M[row][k];
        }
        const double p = row == 0 ? p0 : p1;
        J[6] = distortion * p;
        J[7] = f * r2 * p;
        J[8] = f * r2 * r2 * p;
      }
    }
    if (jacobians[1] != nullptr) {
      for (int row = 0; row < 2; ++row)
        for (int k = 0; k < 3; ++k)
          jacobians[1][3 * row + k] =
              M[row][0] * R[0][k] + M[row][1] * R[1][k] + M[row][2] * R[2][k];
    }
    return true;
  }

 private:
  double u_, v_;
};

struct Observation {
  int camera, point;
  double u, v;
};

struct Bal {
  std::vector<Observation> observations;
  std::vector<double> cameras, points;

  bool read(const char* path) {
    std::FILE* file = std::fopen(path, "r");
    if (file == nullptr) return false;
    size_t camera_count, point_count, observation_count;
    bool good = std::fscanf(file, "%zu %zu %zu", &camera_count, &point_count,
                            &observation_count) == 3;
    if (good) {
      observations.resize(observation_count);
      cameras.resize(9 * camera_count);
      points.resize(3 * point_count);
    }
    for (Observation& o : observations)
      good = good && std::fscanf(file, "%d %d %lf %lf", &o.camera, &o.point, &o.u, &o.v) == 4;
    for (std::vector<double>* values : {&cameras, &points})
      for (double& value : *values) good = good && std::fscanf(file, "%lf", &value) == 1;
    std::fclose(file);
    return good;
  }
};

struct Entry {
  int iteration;
  double cost, seconds;
};

class Log final : public ceres::IterationCallback {
 public:
  explicit Log(Clock::time_point begin) : begin_(begin) {}

  ceres::CallbackReturnType operator()(const ceres::IterationSummary& summary) override {
    entries.push_back({summary.iteration, summary.cost, since(begin_)});
    return ceres::SOLVER_CONTINUE;
  }

  std::vector<Entry> entries;

 private:
  Clock::time_point begin_;
};

// The highest resident memory of this process, in MB.
double peak_memory_mb() {
  std::ifstream status("/proc/self/status");
  std::string line;
  while (std::getline(status, line))
    if (line.rfind("VmHWM:", 0) == 0) return std::atof(line.c_str() + 6) / 1024.0;
  return 0.0;
}

}  // namespace

int main(int count, char** arguments) {
  google::InitGoogleLogging(arguments[0]);
  if (count != 7) {
    std::cerr << "usage: ceres_bal FILE dense|sparse|iterative trivial|huber:A THREADS TOLERANCE "
                 "MAX_ITERATIONS\n";
    return 2;
  }
  const std::string variant = arguments[2], loss = arguments[3];
  Bal bal;
  if (!bal.read(arguments[1])) {
    std::cerr << arguments[1] << ": not a readable BAL file\n";
    return 1;
  }

  ceres::Solver::Options options;
  if (variant == "dense") {
    options.linear_solver_type = ceres::DENSE_SCHUR;
  } else if (variant == "sparse") {
    options.linear_solver_type = ceres::SPARSE_SCHUR;
  } else if (variant == "iterative") {
    options.linear_solver_type = ceres::ITERATIVE_SCHUR;
    options.preconditioner_type = ceres::SCHUR_JACOBI;
  } else {
    std::cerr << variant << ": expected dense, sparse or iterative\n";
    return 2;
  }

  const Clock::time_point building = Clock::now();
  ceres::Problem::Options problem_options;
  problem_options.enable_fast_removal = false;
  std::unique_ptr<ceres::LossFunction> robust;
  if (loss.rfind("huber:", 0) == 0) {
    robust = std::make_unique<ceres::HuberLoss>(std::atof(loss.c_str() + 6));
    problem_options.loss_function_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  } else if (loss != "trivial") {
    std::cerr << loss << ": expected trivial or huber:A\n";
    return 2;
  }
  ceres::Problem problem(problem_options);
  for (const Observation& o : bal.observations)
    problem.AddResidualBlock(new Reprojection(o.u, o.v), robust.get(), &bal.cameras[9 * o.camera],
                             &bal.points[3 * o.point]);
  // A point or camera that nobody observes is no parameter.
  auto* ordering = new ceres::ParameterBlockOrdering;
  for (size_t i = 0; i < bal.points.size(); i += 3)
    if (problem.HasParameterBlock(&bal.points[i])) ordering->AddElementToGroup(&bal.points[i], 0);
  for (size_t i = 0; i < bal.cameras.size(); i += 9)
    if (problem.HasParameterBlock(&bal.cameras[i])) ordering->AddElementToGroup(&bal.cameras[i], 1);
  options.linear_solver_ordering.reset(ordering);
  const double build_seconds = since(building);

  options.num_threads = std::atoi(arguments[4]);
  options.function_tolerance = std::atof(arguments[5]);
  options.max_num_iterations = std::atoi(arguments[6]);
  options.gradient_tolerance = 0.0;
  options.parameter_tolerance = 0.0;
  options.logging_type = ceres::SILENT;
  const Clock::time_point begin = Clock::now();
  Log log(begin);
  options.callbacks.push_back(&log);
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  const double solve_seconds = since(begin);
  if (!summary.IsSolutionUsable()) {
    std::cerr << summary.message << "\n";
    return 1;
  }

  std::printf("{\"initial_cost\":%.17g,\"final_cost\":%.17g,\"iterations\":%d,"
              "\"build_seconds\":%.9g,\"solve_seconds\":%.9g,\"peak_memory_mb\":%.2f,"
              "\"stop\":\"%s\",\"version\":\"%s\",\"log\":[",
              summary.initial_cost, summary.final_cost,
              summary.num_successful_steps + summary.num_unsuccessful_steps - 1, build_seconds,
              solve_seconds, peak_memory_mb(),
              ceres::TerminationTypeToString(summary.termination_type), CERES_VERSION_STRING);
  for (size_t i = 0; i < log.entries.size(); ++i)
    std::printf("%s[%d,%.17g,%.9g]", i == 0 ? "" : ",", log.entries[i].iteration,
                log.entries[i].cost, log.entries[i].seconds);
  std::printf("]}\n");
  return 0;
}
