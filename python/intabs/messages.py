"""LCM messages and channel names. The classes are generated from proto_lcm/*.lcm by tools/setup (python/intabs_lcm)."""

try:
    from intabs_lcm import (
        estop_t,
        hand_keypoints_t,
        hand_points_t,
        lite6_command_t,
        lite6_status_t,
        loop_status_t,
        object_poses_t,
        perception_status_t,
        plant_control_t,
        plant_truth_t,
        reset_t,
        skill_control_t,
        skill_plan_t,
        skill_status_t,
        skill_t,
        tag_detections_t,
    )
except ImportError as e:
    raise ImportError(f"{e}: python/intabs_lcm is missing or old, run tools/setup --runtime-only") from None

# Channel -> message. TAG_DETECTIONS_, HAND_KEYPOINTS_ and HAND_POINTS_<camera> have one channel a camera.
CHANNELS = {
    "LITE6_STATUS": lite6_status_t,
    "LITE6_COMMAND": lite6_command_t,
    "OBJECT_POSES": object_poses_t,
    "PERCEPTION_STATUS": perception_status_t,
    "SKILL_PLAN": skill_plan_t,
    "SKILL_STATUS": skill_status_t,
    "SKILL_CONTROL": skill_control_t,
    "LOOP_STATUS": loop_status_t,
    "PLANT_TRUTH": plant_truth_t,
    "PLANT_CONTROL": plant_control_t,
    "ESTOP": estop_t,
    "RESET": reset_t,
    "TAG_DETECTIONS_left": tag_detections_t,
    "TAG_DETECTIONS_right": tag_detections_t,
    "HAND_KEYPOINTS_left": hand_keypoints_t,
    "HAND_KEYPOINTS_right": hand_keypoints_t,
    "HAND_POINTS_left": hand_points_t,
    "HAND_POINTS_right": hand_points_t,
}

SKILLS_PER_PART = 16  # of a SKILL_PLAN message: 1400 bytes hold no more


def plan_parts(plan_id: int, skills: list[dict]) -> list[skill_plan_t]:
    """A plan as messages. Each skill: {"z": [16 floats], "min_ticks": n, "max_ticks": n}, and
    {"library_index": n} if it is one of the library beside the weights."""
    chunks = [skills[i : i + SKILLS_PER_PART] for i in range(0, len(skills), SKILLS_PER_PART)]
    parts = []
    for number, chunk in enumerate(chunks):
        message = skill_plan_t()
        message.seq = number + 1
        message.plan_id = plan_id
        message.part, message.parts = number, len(chunks)
        message.n = len(chunk)
        for entry in chunk:
            skill = skill_t()
            skill.z = [float(v) for v in entry["z"]]
            skill.library_index = int(entry.get("library_index", -1))
            skill.min_ticks, skill.max_ticks = int(entry["min_ticks"]), int(entry["max_ticks"])
            message.skills.append(skill)
        parts.append(message)
    return parts
