"""Arms share the scenes of an evaluation: what deviates from most is found, but for what a change may differ in."""

from dataclasses import replace

import pytest
from clean_episode import CLEAN, moved

from roboxim_eval.experiments.proving.changes import changed_parts
from roboxim_eval.experiments.proving.proofs import Tally, pairing


def arms_of(number, **defects):
    """Return conditions a, b, ... with the clean scene, some with a defect."""
    names = "abcdefghij"[:number]
    return {name: [replace(CLEAN, bag=f"episodes/{name}", **defects.get(name, {}))] for name in names}


OTHER_SCENES = ({"state_hash": "b" * 32}, {"pictures": {"workspace": 8}})


@pytest.mark.parametrize("defect", OTHER_SCENES)
@pytest.mark.parametrize("bad", ["a", "d", "f"])
def test_an_arm_that_deviates_from_most_is_the_faulty_one(bad, defect):
    assert pairing(arms_of(6), {}).checks == {"pairing": (6, 6)}
    found = pairing(arms_of(6, **{bad: defect}), {})
    assert found.faulty == {f"episodes/{bad}"}
    assert found.checks == {"pairing": (5, 6)}
    assert all(fault.check == "pairing" for fault in found.faults)


@pytest.mark.parametrize("defect", OTHER_SCENES)
def test_without_a_majority_a_scene_is_a_fault_of_every_arm(defect):
    assert pairing(arms_of(2), {}).checks == {"pairing": (2, 2)}
    assert pairing(arms_of(2, b=defect), {}).faulty == {"episodes/a", "episodes/b"}
    tie = pairing(arms_of(4, b=defect, c=defect), {})
    assert len(tie.faulty) == len(tie.faults) == 4
    assert tie.checks == {"pairing": (0, 4)}
    assert "no majority of 'a', 'b', 'c', 'd' agrees" in tie.faults[0].text
    lit = [replace(CLEAN, bag="episodes/lit", thumbnails={"workspace": (104, 100)})]
    assert len(pairing(arms_of(2, b=defect) | {"lit": lit}, {"lit": ["reset.lights"]}).faulty) == 3


def test_each_scene_has_its_own_majority():
    arms = {
        name: [replace(CLEAN, bag=f"{name}{number}", number=number) for number in range(3)] for name in "abc"
    }  # fmt: skip
    arms["a"][0] = replace(arms["a"][0], state_hash="b" * 32)
    arms["b"][2] = replace(arms["b"][2], state_hash="b" * 32)
    found = pairing(arms, {})
    assert found.faulty == {"a0", "b2"}
    assert found.checks == {"pairing": (7, 9)}
    assert str(found.faults[0]) == "a0: pairing: the state of tick 0 is bbbbbbbb, that of 'b' is aaaaaaaa"


def test_a_scene_of_one_arm_alone_is_not_checked():
    other = replace(CLEAN, bag="episodes/other", number=1)
    assert pairing({"a": [CLEAN], "b": [other]}, {}).checks == {}, "no scene is shared"
    assert pairing({"a": [CLEAN], "b": [], "c": [CLEAN]}, {}).checks == {"pairing": (2, 2)}


def test_arms_whose_pictures_have_other_sizes_must_share_cameras_and_looks():
    large = {"pictures": {"workspace": 8}, "sizes": {"workspace": (256, 320, 3)}}
    assert pairing(arms_of(3, c=large), {}).checks == {"pairing": (3, 3)}
    for defect in ({"cameras": {"workspace": moved(0.01)}}, {"look": {**CLEAN.look, "light.intensity": 3.0}}):
        assert pairing(arms_of(3, c=large | defect), {}).faulty == {"episodes/c"}
        assert pairing(arms_of(2, b=large | defect), {}).faulty == {"episodes/a", "episodes/b"}
    # a small one deviates: its state, look or camera, not the picture of the other small one, tells which is right
    for defect in ({"state_hash": "b" * 32}, {"look": {**CLEAN.look, "light.intensity": 3.0}}):
        arms = arms_of(3, c=large, a={"pictures": {"workspace": 9}, **defect})
        assert pairing(arms, {}).faulty == {"episodes/a"}


def test_a_changed_light_must_change_the_picture_and_nothing_else():
    lit = replace(CLEAN, bag="episodes/lit", pictures={"workspace": 8}, thumbnails={"workspace": (104, 100)})
    changed = {"light": ["reset.lights"]}
    assert pairing({"a": [CLEAN], "light": [lit]}, changed).checks == {"pairing": (2, 2), "changed": (1, 1)}
    (same,) = pairing({"a": [CLEAN], "light": [replace(CLEAN, bag="episodes/lit")]}, changed).faults
    assert (same.check, same.bag) == ("changed", "episodes/lit")
    (shoved,) = pairing({"a": [CLEAN], "light": [replace(lit, state_hash="b" * 32)]}, changed).faults
    assert (shoved.check, shoved.bag) == ("pairing", "episodes/lit")
    assert pairing({"a": [CLEAN], "other": [lit]}, {"other": ["scene"]}) == Tally(), "another scene shares nothing"
    arms = arms_of(3, a={"state_hash": "b" * 32, "thumbnails": {"workspace": (104, 100)}}) | {"light": [lit]}
    assert pairing(arms, changed).faulty == {"episodes/a"}, "the light is compared with the majority"


MASS = {"physics": {"target": {"mass_kg": 0.16}}, "modifiers": {"target": {"color": "red", "mass": 2.0}}}
OTHER_PICTURE = {"pictures": {"workspace": 8}, "thumbnails": {"workspace": (104, 100)}}
NUDGED = {"positions": {"target": (0.4, 0.0004, 0.02)}, "state_hash": "b" * 32}
SHOVED = {"positions": {"target": (0.4, 0.004, 0.02)}, "state_hash": "b" * 32}
CHANGES = {
    "words": {"templates": {"values": ["Lift the {target}"]}},
    "mass": {"objects": {"target": {"modifiers": {"mass": {"values": [2.0]}}}}},
    "exposure": {"reset": {"cameras": {"exposure_ev": {"workspace": {"values": [1.0]}}}}},
    "camera": {"reset": {"cameras": {"shift_m": {"workspace": {"lower": [-0.1] * 3, "upper": [0.1] * 3}}}}},
    "start": {"reset": {"robot": {"position": {"lower": [0.3] * 3, "upper": [0.6] * 3}}}},
    "color": {"objects": {"target": {"modifiers": {"color": {"values": ["blue"]}}}}},
    "distractors": {"distractors": {"minimum": 2, "maximum": 2}},
    "noise": {"reset": {"cameras": {"views": {"workspace": {"values": ["workspace_noisy"]}}}}},
}
"""What conditions set; named as in `robustness`."""
DELIVERED = {
    "words": {"instruction": "Lift the red cube"},
    "mass": {**MASS, **NUDGED, "pictures": {"workspace": 8}},
    "exposure": {**OTHER_PICTURE, "look": {**CLEAN.look, "exposure.workspace": 1.0}},
    "camera": {**OTHER_PICTURE, **SHOVED, "cameras": {"workspace": moved(0.05)}},
    "start": {**OTHER_PICTURE, **SHOVED, "start": (0.4, -0.1, 0.3)},
    "color": {**OTHER_PICTURE, **SHOVED, "modifiers": {"target": {"color": "blue"}}},
    "noise": {"pictures": {"workspace": 8}, "look": {**CLEAN.look, "noise.workspace": (0.05, 0.004, 0.0)}},
    "distractors": {**OTHER_PICTURE, **SHOVED, "others": {"distractor_1": "apple", "distractor_2": "cube"}},
}
"""What an episode of each may differ in from the unchanged one."""


def paired(name, **defect):
    other = replace(CLEAN, **{"bag": "episodes/changed", **DELIVERED[name], **defect})
    return pairing({"nominal": [CLEAN], name: [other]}, {name: changed_parts(CHANGES[name])})


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_condition_shares_what_its_change_leaves(name):
    found = paired(name)
    assert found.faults == ()
    assert found.checks["pairing"] == (2, 2)
    assert ("changed" in found.checks) == (name not in ("words", "mass")), "pictures must differ where they show it"
    assert bool(found.statements) == (name in ("camera", "start", "color", "distractors")), found.statements


@pytest.mark.parametrize(
    ("name", "text", "defect"),
    [
        ("words", "the state of tick 0 is bbbbbbbb, that of 'nominal' is aaaaaaaa", NUDGED),
        ("words", "its pictures are not those of 'nominal'", {"pictures": {"workspace": 8}}),
        ("mass", "the target lies 4.0 mm from where it does", SHOVED),
        ("mass", "its pictures are 2.00 of 255 from those of 'nominal'", OTHER_PICTURE),
        ("mass", "color of the target is blue", {"modifiers": {"target": {"color": "blue", "mass": 2.0}}}),
        ("mass", "the tool starts 50.0 mm from where it does", {"start": (0.4, 0.0, 0.35)}),
        ("exposure", "the state of tick 0 is bbbbbbbb", NUDGED),
        ("exposure", "light.intensity is 3.0", {"look": {"light.intensity": 3.0, "table.texture": "wood"}}),
        ("camera", "light.intensity is 3.0", {"look": {"light.intensity": 3.0, "table.texture": "wood"}}),
        ("camera", "the model of the target is apple", {"models": {"target": "apple"}}),
        ("camera", "the tool starts 50.0 mm", {"start": (0.4, 0.0, 0.35)}),
        ("start", "the model of distractor_1 is lemon", {"others": {"distractor_1": "lemon"}}),
        ("color", "the pose of camera 'workspace' is", {"cameras": {"workspace": moved(0.01)}}),
        ("distractors", "mass of the target is 2.0, with 'nominal' it is missing", MASS),
    ],
)
def test_what_a_change_has_nothing_to_do_with_must_not_differ(name, text, defect):
    (fault,) = paired(name, **defect).faults
    assert (fault.check, fault.bag) == ("pairing", "episodes/changed")
    assert text in fault.text


@pytest.mark.parametrize("name", ["exposure", "camera"])
def test_a_changed_camera_that_shows_the_same_picture_was_not_delivered(name):
    (fault,) = paired(name, thumbnails=CLEAN.thumbnails, pictures=CLEAN.pictures).faults
    assert (fault.check, fault.bag) == ("changed", "episodes/changed")


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("noise", "noise.workspace"),
        ("color", "color of the target"),
        ("distractors", "distractor_2"),
        ("start", "the start of the tool"),
    ],
)
def test_pictures_must_show_every_change_that_can_be_seen(name, what):
    (fault,) = paired(name, pictures=CLEAN.pictures, thumbnails=CLEAN.thumbnails).faults
    assert (fault.check, fault.bag) == ("changed", "episodes/changed")
    assert what in fault.text
    little = paired(name, thumbnails=CLEAN.thumbnails)
    assert little.faults == (), "a small object changes few pixels, and noise their mean by little"
    assert little.checks["changed"] == (1, 1)


def test_a_part_of_a_task_that_may_change_everything_claims_nothing():
    assert changed_parts({"scene": "clutter", "reset": {"cameras": None}}) == ("scene", "reset.cameras")
    other = replace(CLEAN, bag="episodes/changed", **SHOVED)
    for parts in (["scene"], ["reset.cameras"], ["templates", "rate_hz"]):
        assert pairing({"nominal": [CLEAN], "other": [other]}, {"other": parts}) == Tally()
    assert pairing({"nominal": [CLEAN], "other": [other]}, {"other": ["templates"]}).faulty == {"episodes/changed"}
