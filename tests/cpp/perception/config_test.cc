#include "intabs/perception/config.h"

#include <catch2/catch.hpp>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <string>

using namespace intabs;

namespace {

const std::string kGood = R"(cameras:
  - {name: left, width: 640, height: 480, fx: 610, fy: 610, cx: 319.5, cy: 239.5}
ground: {id: 0, size: 0.12, X_WT: {p: [0.4, 0, 0], q: [0, 1, 0, 0]}}
objects:
  - slot: 0
    id: 5
    name: block
    tags:
      - {id: 10, size: 0.032, X_OT: {p: [0.0, 0, 0.1], q: [1, 0, 0, 0]}}
)";

// Reads the text as a file.
PerceptionConfig Load(const std::string& text) {
  const auto path =
      std::filesystem::temp_directory_path() / ("perception_" + std::to_string(::getpid()) + ".yaml");
  std::ofstream(path) << text;
  struct Remove {
    std::filesystem::path path;
    ~Remove() { std::filesystem::remove(path); }
  } remove{path};
  return LoadPerceptionConfig(path.string());
}

std::string With(const std::string& from, const std::string& to) {
  std::string text = kGood;
  text.replace(text.find(from), from.size(), to);
  return text;
}

}  // namespace

TEST_CASE("A configuration is read as it is written") {
  const PerceptionConfig config = Load(kGood);
  REQUIRE(config.cameras.size() == 1);
  CHECK(config.cameras[0].name == "left");
  CHECK(config.cameras[0].cx == 319.5);
  CHECK_FALSE(config.cameras[0].X_WC);
  CHECK(config.ground->X_WT.p.x() == 0.4);
  CHECK(config.ground->X_WT.q.x() == 1);
  REQUIRE(config.objects.size() == 1);
  CHECK(config.objects[0].id == 5);
  CHECK(config.objects[0].tags[0].X_OT.p.z() == 0.1);
}

TEST_CASE("A faulty configuration is refused in one line that names file, field and value") {
  CHECK_THROWS_WITH(LoadPerceptionConfig("/nowhere/p.yaml"), Catch::Contains("/nowhere/p.yaml"));
  const auto refused = [](const std::string& text, const std::string& part) {
    INFO(text);
    try {
      Load(text);
      FAIL("was accepted");
    } catch (const std::runtime_error& e) {
      const std::string what = e.what();
      CHECK_THAT(what, Catch::Contains("perception_") && Catch::Contains(part));
      CHECK(what.find('\n') == std::string::npos);
    }
  };
  refused(With("width: 640", "width: wide"), "cameras[0].width");
  refused(With("width: 640", "widht: 640"), "widht");
  refused(With("fx: 610, ", ""), "fx");
  refused(With("fx: 610", "fx: -610"), "camera left");
  refused(With("q: [0, 1, 0, 0]", "q: [0, 1, 0, 1]"), "norm");
  refused(With("q: [0, 1, 0, 0]", "q: [0, 1, 0]"), "4 numbers");
  refused(With("size: 0.032", "size: 0"), "tag 10");
  refused(With("id: 10", "id: 0"), "tag 0 is used twice");
  refused(With("slot: 0", "slot: 4"), "slot 4");
  refused(With("ground:", "grnd:"), "grnd");
  refused(With("ground: {id: 0, size: 0.12, X_WT: {p: [0.4, 0, 0], q: [0, 1, 0, 0]}}\n", ""), "ground tag");
  refused("cameras: [", "YAML");
  refused("", "");
}
