"""Meanings of the reasons of failures and errors, a sentence each."""

from __future__ import annotations

import re

EXPLANATIONS = {
    # the goal was not reached
    "max_steps": "The limit of actions was reached before any condition was.",
    "not_grasped": "The fingers did not hold the object from two sides.",
    "not_lifted": "The object was held or touched, but not raised far enough.",
    "not_pushed": "The object was not moved far enough along the direction.",
    "not_straight": "The object left the straight line to its goal.",
    "not_turned": "The object or knob was not turned by the required angle in the required direction.",
    "not_opened": "The drawer or door was not opened far enough.",
    "not_shut": "The drawer or door was not shut completely.",
    "not_pressed": "The button was not pressed down.",
    "not_by_finger": "The button went down, but not under a finger.",
    "not_flipped": "The lever was not turned to its other side.",
    "not_by_finger_alone": "The lever or knob turned, but not under fingers alone.",
    "not_inside": "The object is not inside the container.",
    "not_on_support": "The object does not rest on its support.",
    "not_on_table": "The object does not stand on the table.",
    "not_upright": "The object does not stand upright.",
    "not_in_direction": "The object is not on the side that the instruction names.",
    "too_far_to_the_side": "The object is on the right side, but too far off the line through the reference object.",
    "not_centred": "The object rests on its support, but too far from the middle.",
    "not_at_rest": "The object still moved at the end.",
    "not_rolling": "The object still rolled at the end.",
    "touches_table": "The object still touched the table.",
    "not_released": "The gripper did not let go.",
    "still_held": "The gripper let go too late, or the hand was still at the object.",
    "not_held": "The goal was reached, but not for long enough.",
    "not_stable": "The goal was reached, but not kept after the last action.",
    "not_solved": "The task's conditions were not met.",
    "undone": "What had been done was undone.",
    "before_its_turn": "It was done before its turn, which does not count.",
    # something else happened
    "dropped": "The object fell from too high instead of being set down.",
    "carried": "The object was carried where it was to be pushed.",
    "lifted": "The object was lifted where it had to stay on the table.",
    "toppled": "The object fell over.",
    "put_another_there": "Another object was put where only the named one belongs.",
    "pushed_another_too": "Another object was pushed along with the named one.",
    "leans_on_something": "The object stands only because it leans on something.",
    "opened_other": "Another drawer or door was left open, or another switch or knob turned.",
    "pushed_off_table": "Another object fell off the table.",
    "rests_on_something": "The object rests on something instead of being held in the air.",
    "toppled_other": "Another object fell over.",
    "tossed": "The object was thrown instead of being set down.",
    "moved_away": "The object was moved away from its place.",
    "moved_reference": "The object that the instruction refers to was moved.",
    "moved_other_drawer": "Another drawer was moved.",
    "pressed_other_button": "Another button was pressed.",
    "wrong_object_lifted": "Another object was lifted: the policy took the wrong one.",
    "disturbed_distractor": "An object that was not part of the task was moved.",
    "fell_off_table": "The object fell off the table.",
    "too_much_force": "The robot pressed harder than the task's limit allows.",
    "too_fast": "The tool moved faster than the task's limit allows.",
    "path_too_long": "The tool's path was longer than the task's limit allows.",
    "touched_distractors": "The robot touched more objects that the task is not about than its limit allows.",
    "in_keep_out": "The robot, or what it moved, was in a keep-out volume of the task.",
    "left_workspace": "The tool left the workspace for good.",
    # errors: the policy, not the task
    "policy_fault": "The policy raised an error. The episode counts as failed.",
    "policy_late": "The policy did not answer in time.",
    "policy_died": "The policy's server or process was lost. Such an episode is no result.",
    "invalid_action": "The policy answered a NaN, a wrong shape or values out of range.",
    "worker_died": "The process that ran the episode ended three times.",
    "reset_infeasible": "No scene of this task could be drawn.",
}
"""Reason to its meaning."""
UNNAMED = "unnamed"


def explained(reason: str) -> str:
    """Return the meaning of a reason; an unknown one is spelled out, e.g. a plug-in's ``not_watered``."""
    if reason in EXPLANATIONS:
        return EXPLANATIONS[reason]
    if not reason or reason == UNNAMED:
        return "The task gave no reason."
    if found := re.fullmatch(r"step_(\d+)_(\w+)", reason):
        return f"Step {found[1]}: {explained(found[2])}"
    words = reason.replace("_", " ")
    if found := re.fullmatch(r"not (.+)", words):
        return f"The condition '{found[1]}' was not met."
    return f"{words[0].upper()}{words[1:]}."
