// intabs_calibrate: what lens a camera has, where it stands, and where the arm does. tools/calibrate runs it.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <chrono>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <nlohmann/json.hpp>
#include <opencv2/core/utility.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <sstream>
#include <stdexcept>
#include <thread>

#include "intabs/bus/lcm_bus.h"
#include "intabs/camera/frame_source.h"
#include "intabs/camera/grabber.h"
#include "intabs/kinematics/arm_model.h"
#include "intabs/perception/calibration.h"
#include "intabs/perception/detector.h"
#include "intabs/perception/pipeline.h"
#include "intabs/rt/periodic.h"
#include "intabs/rt/stop_signal.h"

namespace intabs {
namespace {

namespace fs = std::filesystem;

constexpr double kDegree = M_PI / 180;
constexpr double kStill = 0.005;          // rad/s
constexpr int64_t kStillUs = 400'000;     // at rest for so long before a picture counts
constexpr double kNewPose = 5 * kDegree;  // of any joint, from all poses taken

struct Options {
  std::string out, json, config, lcm = kDefaultLcmUrl, prefix;
  std::vector<std::string> pictures, sources;
  std::string camera = "left", samples;
  Board board{7, 5, 0.03, 0};
  double max_rms_px = 0.5;
  int frames = 50, tag = 0;
  double tag_size = 0;
};

std::string Rounded(double v, int digits) {
  char text[32];
  std::snprintf(text, sizeof(text), "%.*f", digits, v);
  return text;
}

std::string Today() {
  const std::time_t now = std::time(nullptr);
  char text[16];
  std::strftime(text, sizeof(text), "%Y-%m-%d", std::gmtime(&now));
  return text;
}

// Lines on stderr now and then, so that long work is seen to go on.
class Progress {
 public:
  void Tell(const std::string& what) {
    if (MonotonicUs() - told_us_ < 2'000'000) return;
    told_us_ = MonotonicUs();
    std::cerr << "intabs_calibrate: " << what << "\n";
  }

 private:
  int64_t told_us_ = MonotonicUs();
};

Calibration LoadOrNew(const std::string& path) {
  return fs::exists(path) ? LoadCalibration(path) : Calibration{};
}

void WriteJson(const Options& o, const nlohmann::json& figures) {
  if (o.json.empty()) return;
  std::ofstream out(o.json);
  out << figures.dump(2) << "\n";
  if (!out.flush()) throw std::runtime_error(o.json + ": cannot be written");
}

nlohmann::json Numbers(const Notes& notes) {
  nlohmann::json out;
  for (const auto& [key, value] : notes) {
    const nlohmann::json parsed = nlohmann::json::parse(value, nullptr, false);
    out[key] = parsed.is_number() ? parsed : nlohmann::json(value);
  }
  return out;
}

Calibration::Camera& FindOrAdd(Calibration& calibration, const std::string& name) {
  for (Calibration::Camera& c : calibration.cameras) {
    if (c.model.name == name) return c;
  }
  calibration.cameras.emplace_back().model.name = name;
  return calibration.cameras.back();
}

std::vector<fs::path> PictureFiles(const std::vector<std::string>& given) {
  std::vector<fs::path> files;
  for (const std::string& g : given) {
    if (!fs::is_directory(g)) {
      files.emplace_back(g);
      continue;
    }
    for (const auto& entry : fs::directory_iterator(g)) {
      if (entry.is_regular_file() && cv::haveImageReader(entry.path().string()))
        files.push_back(entry.path());
    }
  }
  std::sort(files.begin(), files.end());
  return files;
}

void RunIntrinsics(const Options& o) {
  Calibration calibration = LoadOrNew(o.out);
  const std::vector<fs::path> files = PictureFiles(o.pictures);
  std::vector<BoardView> views;
  cv::Size size;
  std::string first, without;
  Progress progress;
  for (size_t i = 0; i < files.size() && !StopRequested(); ++i) {
    const std::string name = files[i].string();
    const cv::Mat gray = cv::imread(name, cv::IMREAD_GRAYSCALE);
    if (gray.empty()) throw std::runtime_error(name + ": no readable picture");
    if (first.empty()) {
      first = name;
      size = gray.size();
    }
    if (gray.size() != size) {
      throw std::runtime_error(name + " has " + std::to_string(gray.cols) + " x " +
                               std::to_string(gray.rows) + " px, " + first + " " +
                               std::to_string(size.width) + " x " + std::to_string(size.height) +
                               ": give pictures of one camera, none of them turned");
    }
    if (auto view = FindBoard(gray, o.board)) {
      view->name = files[i].filename();
      views.push_back(*view);
    } else {
      without += (without.empty() ? "" : ", ") + files[i].filename().string();
    }
    progress.Tell("picture " + std::to_string(i + 1) + " of " + std::to_string(files.size()));
  }
  if (StopRequested()) throw std::runtime_error("stopped, nothing written");
  if (!without.empty()) std::cerr << "intabs_calibrate: no board found in " << without << "\n";
  const Intrinsics r = CalibrateIntrinsics(views, size, o.max_rms_px);
  for (const std::string& name : r.dropped)
    std::cerr << "intabs_calibrate: left out, does not fit: " << name << "\n";

  Calibration::Camera& camera = FindOrAdd(calibration, o.camera);
  const CameraModel before = camera.model;
  camera.model = r.model;
  camera.model.name = before.name;
  camera.model.source = before.source;  // where it stands was found with the old lens
  camera.extrinsics.clear();
  camera.intrinsics = {{"date", Today()},
                       {"pictures", std::to_string(r.views)},
                       {"left_out", std::to_string(r.dropped.size())},
                       {"rms_px", Rounded(r.rms_px, 4)},
                       {"held_out_rms_px", Rounded(r.held_out_rms_px, 4)},
                       {"coverage", Rounded(r.coverage, 3)},
                       {"tilt_deg", Rounded(r.tilt / kDegree, 1)}};
  SaveCalibration(o.out, calibration);
  const CameraModel& m = camera.model;
  nlohmann::json figures = Numbers(camera.intrinsics);
  figures["fx"] = m.fx;
  figures["fy"] = m.fy;
  figures["cx"] = m.cx;
  figures["cy"] = m.cy;
  figures["distortion"] = m.distortion;
  WriteJson(o, figures);
  std::cout << "camera " << o.camera << ": fx " << Rounded(m.fx, 2) << " fy " << Rounded(m.fy, 2) << " cx "
            << Rounded(m.cx, 2) << " cy " << Rounded(m.cy, 2) << "; " << r.views << " pictures, RMS "
            << Rounded(r.rms_px, 3) << " px (" << Rounded(r.held_out_rms_px, 3)
            << " px on pictures held out), " << Rounded(100 * r.coverage, 0) << " % covered -> " << o.out
            << "\n";
}

struct Source {
  const CameraModel* model;
  int camera;  // index in the configuration
  std::unique_ptr<FrameSource> source;
};

// Those of --source, else those of the configuration.
std::vector<Source> OpenSources(const Options& o, const PerceptionConfig& config) {
  std::vector<Source> out;
  for (size_t i = 0; i < config.cameras.size(); ++i) {
    const CameraModel& c = config.cameras[i];
    std::string spec = c.source;
    for (const std::string& s : o.sources) {
      if (s.starts_with(c.name + "=")) spec = s.substr(c.name.size() + 1);
    }
    if (spec.empty()) continue;
    out.push_back(
        {&c, static_cast<int>(i), OpenSource(spec, {c.name, c.width, c.height}, [](const std::string& what) {
           std::cerr << "intabs_calibrate: " << what << "\n";
         })});
  }
  for (const std::string& s : o.sources) {
    if (std::none_of(out.begin(), out.end(),
                     [&](const Source& x) { return s.starts_with(x.model->name + "="); }))
      throw std::runtime_error("--source " + s + ": give CAMERA=KIND:WHERE with a camera of " + o.config);
  }
  if (out.empty())
    throw std::runtime_error("no source: give --source CAMERA=KIND:WHERE, or `source` in " + o.config);
  return out;
}

std::optional<TagCorners> FindTag(TagDetector& detector, const cv::Mat& gray, const CameraModel& camera,
                                  int id) {
  detector.Reset();
  for (const SeenTag& tag : detector.Detect(gray, {}, true)) {
    if (tag.id != id) continue;
    TagCorners corners;
    for (int k = 0; k < 4; ++k) corners[k] = camera.Undistort(tag.corners[k]);
    return corners;
  }
  return std::nullopt;
}

void RunExtrinsics(const Options& o) {
  const PerceptionConfig config = LoadPerceptionConfig(o.config);
  if (!config.ground) throw std::runtime_error(o.config + ": names no ground tag");
  Calibration calibration = LoadOrNew(o.out);
  nlohmann::json figures;
  Progress progress;
  std::vector<Source> sources = OpenSources(o, config);
  for (Source& s : sources) {
    TagDetector detector({config.ground->id});
    std::vector<TagCorners> seen;
    Frame frame;
    cv::Mat gray;
    const int64_t begin_us = MonotonicUs();
    for (int n = 0; n < o.frames && !StopRequested();) {
      const Grab grab = s.source->Next(frame);
      if (grab == Grab::kEnd) break;
      if (grab != Grab::kFrame && MonotonicUs() - begin_us > 10'000'000 && n == 0)
        throw std::runtime_error("camera " + s.model->name + " gives no frames");
      if (grab != Grab::kFrame || frame.rgb.empty()) continue;
      ++n;
      RgbToGray(frame.rgb, gray);
      if (const auto corners = FindTag(detector, gray, *s.model, config.ground->id)) seen.push_back(*corners);
      progress.Tell("camera " + s.model->name + ": frame " + std::to_string(n));
    }
    if (StopRequested()) throw std::runtime_error("stopped, nothing written");
    const Extrinsics r = CalibrateExtrinsics(*s.model, *config.ground, seen);
    Calibration::Camera& camera = FindOrAdd(calibration, s.model->name);
    camera.model = *s.model;
    camera.model.X_WC = r.X_WC;
    camera.extrinsics = {{"date", Today()},
                         {"frames", std::to_string(r.frames)},
                         {"rms_px", Rounded(r.rms_px, 4)},
                         {"spread_px", Rounded(r.spread_px, 4)},
                         {"sigma_mm", Rounded(1000 * r.sigma_m, 3)},
                         {"sigma_deg", Rounded(r.sigma_rad / kDegree, 4)}};
    figures[s.model->name] = Numbers(camera.extrinsics);
    std::cout << "camera " << s.model->name << ": " << r.frames << " frames, corners RMS "
              << Rounded(r.rms_px, 3) << " px; stands to " << Rounded(1000 * r.sigma_m, 2) << " mm and "
              << Rounded(r.sigma_rad / kDegree, 3) << " deg (1 sigma) -> " << o.out << "\n";
  }
  SaveCalibration(o.out, calibration);
  WriteJson(o, figures);
}

// Rows of samples.csv: a picture a camera (may be empty), then q1 .. q6 [rad]. The first row names the
// columns.
struct Row {
  std::vector<std::pair<std::string, std::string>> pictures;  // camera, file
  JointVector q;
};

std::vector<Row> ReadSamples(const std::string& path) {
  std::ifstream in(path);
  if (!in) throw std::runtime_error(path + ": cannot be read");
  const auto split = [](const std::string& line) {
    std::vector<std::string> cells;
    std::istringstream stream(line);
    for (std::string cell; std::getline(stream, cell, ',');) cells.push_back(cell);
    return cells;
  };
  std::string line;
  std::getline(in, line);
  const std::vector<std::string> head = split(line);
  const size_t cameras = head.size() < 7 ? 0 : head.size() - kNumJoints;
  if (cameras == 0 || head[cameras] != "q1")
    throw std::runtime_error(path + ": line 1 must name the cameras, then q1,q2,q3,q4,q5,q6");
  std::vector<Row> rows;
  for (int number = 2; std::getline(in, line); ++number) {
    if (line.empty()) continue;
    const std::vector<std::string> cells = split(line);
    Row row;
    for (int k = 0; k < kNumJoints && cells.size() == head.size(); ++k) {
      char* end = nullptr;
      const std::string& cell = cells[cameras + k];
      row.q[k] = std::strtod(cell.c_str(), &end);
      if (end == cell.c_str() || *end != '\0' || !std::isfinite(row.q[k])) row.q[k] = NAN;
    }
    if (cells.size() != head.size() || !row.q.allFinite()) {
      throw std::runtime_error(path + ": line " + std::to_string(number) + ": expected " +
                               std::to_string(cameras) + " file names and 6 joint angles in rad");
    }
    for (size_t c = 0; c < cameras; ++c) {
      if (!cells[c].empty()) row.pictures.emplace_back(head[c], cells[c]);
    }
    rows.push_back(row);
  }
  return rows;
}

void RunHandEye(const Options& o) {
  const PerceptionConfig config = LoadPerceptionConfig(o.config);
  Calibration calibration = LoadOrNew(o.out);
  const std::string csv = o.samples + "/samples.csv";
  const std::vector<Row> rows = ReadSamples(csv);
  const ArmModel arm = ArmModel::Lite6();
  std::vector<PlacedCamera> placed;
  for (const CameraModel& c : config.cameras) {
    if (!c.X_WC) {
      throw std::runtime_error("camera " + c.name + " has no X_WC in " + o.config +
                               ": find it first (tools/calibrate extrinsics)");
    }
    placed.push_back({&c, *c.X_WC, {}});
  }
  TagDetector detector({o.tag});
  std::vector<HandEyeSample> samples;
  Progress progress;
  for (const Row& row : rows) {
    HandEyeSample s;
    s.X_BE = arm.Fk(row.q);
    for (const auto& [camera, file] : row.pictures) {
      const auto named = [&, name = camera](const CameraModel& c) { return c.name == name; };
      const auto c = std::find_if(config.cameras.begin(), config.cameras.end(), named);
      if (c == config.cameras.end())
        throw std::runtime_error(csv + ": " + o.config + " has no camera " + camera);
      const std::string path = o.samples + "/" + file;
      const cv::Mat gray = cv::imread(path, cv::IMREAD_GRAYSCALE);
      if (gray.empty()) throw std::runtime_error(path + ": no readable picture");
      if (gray.cols != c->width || gray.rows != c->height) {
        throw std::runtime_error(path + ": has " + std::to_string(gray.cols) + " x " +
                                 std::to_string(gray.rows) + " px, camera " + camera + " " +
                                 std::to_string(c->width) + " x " + std::to_string(c->height));
      }
      s.name += (s.name.empty() ? "" : "+") + file;
      if (const auto corners = FindTag(detector, gray, *c, o.tag))
        s.views.push_back({static_cast<int>(c - config.cameras.begin()), *corners});
    }
    samples.push_back(s);
    if (StopRequested()) throw std::runtime_error("stopped, nothing written");
    progress.Tell("pose " + std::to_string(samples.size()) + " of " + std::to_string(rows.size()));
  }
  const HandEye r = CalibrateHandEye(placed, o.tag_size, samples);
  for (const std::string& name : r.dropped)
    std::cerr << "intabs_calibrate: left out, does not fit: " << name << "\n";
  calibration.X_WB = r.X_WB;
  calibration.hand_eye = {{"date", Today()},
                          {"samples", std::to_string(r.samples)},
                          {"left_out", std::to_string(r.dropped.size())},
                          {"rms_px", Rounded(r.rms_px, 4)},
                          {"rms_mm", Rounded(1000 * r.rms_m, 3)},
                          {"sigma_mm", Rounded(1000 * r.sigma_m, 3)},
                          {"sigma_deg", Rounded(r.sigma_rad / kDegree, 4)},
                          {"turn_deg", Rounded(r.turn / kDegree, 1)},
                          {"axes_spread", Rounded(r.spread, 3)}};
  if (calibration.cameras.empty()) {  // so that the file is whole
    for (const CameraModel& c : config.cameras) FindOrAdd(calibration, c.name).model = c;
  }
  SaveCalibration(o.out, calibration);
  WriteJson(o, Numbers(calibration.hand_eye));
  std::cout << "arm base in W: " << Rounded(1000 * r.X_WB.p.x(), 2) << " " << Rounded(1000 * r.X_WB.p.y(), 2)
            << " " << Rounded(1000 * r.X_WB.p.z(), 2) << " mm, known to " << Rounded(1000 * r.sigma_m, 2)
            << " mm and " << Rounded(r.sigma_rad / kDegree, 3) << " deg (1 sigma); " << r.samples
            << " poses, RMS " << Rounded(r.rms_px, 3) << " px, " << Rounded(1000 * r.rms_m, 2) << " mm -> "
            << o.out << "\n";
}

// Guide the arm from pose to pose: whenever it rests in a new one, a picture of each camera and its joints
// are kept.
void RunCapture(const Options& o) {
  const PerceptionConfig config = LoadPerceptionConfig(o.config);
  std::vector<Source> sources = OpenSources(o, config);
  // Read all the time, or a driver's queue would hand out pictures of before the arm came to rest.
  std::vector<std::unique_ptr<Grabber>> grabbers;
  for (Source& s : sources) grabbers.push_back(std::make_unique<Grabber>(std::move(s.source), [] {}));
  LcmBus bus(o.lcm, o.prefix);
  Newest<ArmStatus> newest;
  bus.Subscribe(kLite6Status,
                std::function<void(const ArmStatus&)>([&](const ArmStatus& s) { newest.Offer(s); }));
  fs::create_directories(o.samples);
  const std::string csv = o.samples + "/samples.csv";
  if (fs::exists(csv)) throw std::runtime_error(csv + " is there already: give another folder");
  std::ofstream out(csv);
  for (const Source& s : sources) out << s.model->name << ",";
  out << "q1,q2,q3,q4,q5,q6\n" << std::flush;
  std::vector<JointVector> taken;
  JointVector rest_q = JointVector::Constant(1e9);
  int64_t rest_us = 0;
  Progress progress;
  while (!StopRequested() && static_cast<int>(taken.size()) < o.frames) {
    if (bus.Handle(20) < 0) throw std::runtime_error("LCM is broken on " + o.lcm);
    progress.Tell(std::to_string(taken.size()) + " poses so far; Ctrl-C ends");
    ArmStatus status;
    if (!newest.Take(status)) continue;
    if (status.dq.cwiseAbs().maxCoeff() > kStill || (status.q - rest_q).cwiseAbs().maxCoeff() > kStill) {
      rest_q = status.q;
      rest_us = status.utime;
    }
    if (status.utime - rest_us < kStillUs) continue;
    if (std::any_of(taken.begin(), taken.end(),
                    [&](const JointVector& q) { return (q - status.q).cwiseAbs().maxCoeff() < kNewPose; })) {
      continue;
    }
    char number[16];
    std::snprintf(number, sizeof(number), "%03zu", taken.size());
    std::string row;
    for (size_t i = 0; i < sources.size(); ++i) {
      const Source& s = sources[i];
      Frame frame;
      grabbers[i]->Take(frame);  // of before
      const int64_t begin_us = MonotonicUs();
      while (!grabbers[i]->Take(frame) || frame.rgb.empty()) {
        if (MonotonicUs() - begin_us > 3'000'000 || StopRequested())
          throw std::runtime_error("camera " + s.model->name + " gives no frames");
        std::this_thread::sleep_for(std::chrono::milliseconds(2));
      }
      const std::string file = s.model->name + "_" + number + ".png";
      cv::Mat bgr;
      cv::cvtColor(frame.rgb, bgr, cv::COLOR_RGB2BGR);
      if (!cv::imwrite(o.samples + "/" + file, bgr))
        throw std::runtime_error(o.samples + ": cannot be written");
      row += file + ",";
    }
    out << row;
    out.precision(17);
    for (int k = 0; k < kNumJoints; ++k) out << (k ? "," : "") << status.q[k];
    out << "\n" << std::flush;
    if (!out) throw std::runtime_error(csv + ": cannot be written");
    taken.push_back(status.q);
    std::cout << "pose " << taken.size() << " kept\n" << std::flush;
  }
  std::cout << taken.size() << " poses in " << csv << "\n";
}

int Main(int argc, char** argv) {
  Options o;
  o.config = "models/config/perception.yaml";
  CLI::App app{
      "Calibration: lens (intrinsics), where cameras stand (extrinsics), where the arm stands (capture, then "
      "hand-eye). Results go into one YAML file, which a perception configuration takes by `calibration: "
      "FILE`. A set that cannot answer is refused with the reason."};
  app.require_subcommand(1);
  const auto common = [&](CLI::App* sub, bool config) {
    sub->add_option("--out", o.out, "YAML file; what it holds of other cameras stays")->required();
    sub->add_option("--json", o.json, "write the figures there");
    if (config) sub->add_option("--config", o.config, "YAML of intabs_perception")->capture_default_str();
  };
  const auto with_sources = [&](CLI::App* sub) {
    sub->add_option("--source", o.sources, "CAMERA=KIND:WHERE, as for intabs_perception; once a camera")
        ->allow_extra_args(false);
  };
  auto* intrinsics =
      app.add_subcommand("intrinsics", "focal lengths, centre and distortion from pictures of a board");
  common(intrinsics, false);
  intrinsics->add_option("pictures", o.pictures, "files or folders")->required()->check(CLI::ExistingPath);
  intrinsics->add_option("--camera", o.camera, "its name")->capture_default_str();
  intrinsics->add_option("--columns", o.board.columns, "inner corners along the long side; ChArUco: squares")
      ->check(CLI::Range(2, 100))
      ->capture_default_str();
  intrinsics->add_option("--rows", o.board.rows, "along the short side")
      ->check(CLI::Range(2, 100))
      ->capture_default_str();
  intrinsics->add_option("--square", o.board.square, "edge of a square, m")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  intrinsics->add_option("--marker", o.board.marker, "edge of a marker, m: a ChArUco board of DICT_6X6_250")
      ->check(CLI::PositiveNumber);
  intrinsics->add_option("--max-rms", o.max_rms_px, "refuse more, px")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();

  auto* extrinsics =
      app.add_subcommand("extrinsics", "where cameras stand, from many frames of the ground tag");
  common(extrinsics, true);
  with_sources(extrinsics);
  extrinsics->add_option("--frames", o.frames, "of each camera")
      ->check(CLI::Range(10, 100000))
      ->capture_default_str();

  auto* capture =
      app.add_subcommand("capture", "pictures and joints for hand-eye, whenever the arm rests in a new pose");
  capture->add_option("--config", o.config, "YAML of intabs_perception")->capture_default_str();
  with_sources(capture);
  capture->add_option("--samples", o.samples, "folder to make: samples.csv and pictures")->required();
  capture->add_option("--lcm", o.lcm, "LCM URL")->capture_default_str();
  capture->add_option("--prefix", o.prefix, "comes before every channel's name");
  capture->add_option("--poses", o.frames, "end after so many")
      ->check(CLI::Range(1, 10000))
      ->capture_default_str();

  auto* hand_eye =
      app.add_subcommand("hand-eye", "where the arm stands, from a tag on its flange in many poses");
  common(hand_eye, true);
  hand_eye->add_option("--samples", o.samples, "folder with samples.csv: a picture a camera, q1 .. q6 [rad]")
      ->required()
      ->check(CLI::ExistingDirectory);
  hand_eye->add_option("--tag", o.tag, "id of the tag on the flange")->required()->check(CLI::Range(0, 586));
  hand_eye->add_option("--tag-size", o.tag_size, "its black edge, m")->required()->check(CLI::PositiveNumber);
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    if (e.get_exit_code() == 0) return app.exit(e);
    std::cerr << "intabs_calibrate: " << e.what() << " (see --help)\n";
    return 1;
  }
  InstallStopSignals();
  cv::setNumThreads(1);
  try {
    if (*intrinsics) RunIntrinsics(o);
    if (*extrinsics) RunExtrinsics(o);
    if (*capture) RunCapture(o);
    if (*hand_eye) RunHandEye(o);
  } catch (const std::exception& e) {
    std::cerr << "intabs_calibrate: " << e.what() << "\n";
    return 1;
  }
  return 0;
}

}  // namespace
}  // namespace intabs

int main(int argc, char** argv) { return intabs::Main(argc, argv); }
