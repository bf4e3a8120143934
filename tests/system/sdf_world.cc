// Prints what libsdformat reads in a world, one line each: models, and collision shapes by their place in the world.
// sdf_world WORLD.sdf [FOLDER_OF_MODELS]
#include <cstdio>
#include <iostream>
#include <string>

#include <sdf/sdf.hh>

#if SDF_MAJOR_VERSION < 13
using ignition::math::Pose3d;
#else
using gz::math::Pose3d;
#endif

static int failures = 0;

static Pose3d placed(const sdf::SemanticPose &semantic, const std::string &what) {
  Pose3d pose;
  for (const auto &error : semantic.Resolve(pose)) {
    std::cerr << what << ": " << error << "\n";
    ++failures;
  }
  return pose;
}

static void print(const char *kind, const std::string &name, const Pose3d &pose, const std::string &rest) {
  std::printf("%s\t%s\t%.9f\t%.9f\t%.9f\t%.9f\t%s\n", kind, name.c_str(), pose.Pos().X(), pose.Pos().Y(),
              pose.Pos().Z(), pose.Rot().Yaw(), rest.c_str());
}

static std::string shape(const sdf::Geometry &geometry) {
  char text[200] = "other";
  if (const auto *box = geometry.BoxShape())
    std::snprintf(text, sizeof text, "box %.9f %.9f %.9f", box->Size().X(), box->Size().Y(), box->Size().Z());
  if (const auto *cylinder = geometry.CylinderShape())
    std::snprintf(text, sizeof text, "cylinder %.9f %.9f", cylinder->Radius(), cylinder->Length());
  return text;
}

static void walk(const sdf::Model &model, const Pose3d &outer, const std::string &prefix) {
  const std::string name = prefix + model.Name();
  const Pose3d at = outer * placed(model.SemanticPose(), name);
  print("model", name, at, model.Static() ? "static" : "moves");
  for (uint64_t i = 0; i < model.LinkCount(); ++i) {
    const auto *link = model.LinkByIndex(i);
    const Pose3d linkAt = at * placed(link->SemanticPose(), name);
    for (uint64_t j = 0; j < link->CollisionCount(); ++j) {
      const auto *collision = link->CollisionByIndex(j);
      print("collision", name, linkAt * placed(collision->SemanticPose(), name), shape(*collision->Geom()));
    }
  }
  for (uint64_t i = 0; i < model.ModelCount(); ++i) walk(*model.ModelByIndex(i), at, name + "::");
}

int main(int argc, char **argv) {
  sdf::ParserConfig config;
  if (argc > 2) config.AddURIPath("model://", argv[2]);
  sdf::Root root;
  for (const auto &error : root.Load(argv[1], config)) {
    std::cerr << error << "\n";
    ++failures;
  }
  if (root.WorldCount() != 1) return 1;
  const auto *world = root.WorldByIndex(0);
  for (uint64_t i = 0; i < world->ModelCount(); ++i) walk(*world->ModelByIndex(i), Pose3d::Zero, "");
  return failures ? 1 : 0;
}
