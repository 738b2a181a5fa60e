"""Proofs of delivery: each planted defect is found, by name of its bag and with its figure; a clean episode passes."""

from dataclasses import replace

import pytest

from roboxim_core.poses import Pose
from roboxim_eval.experiments.proving.cells_apart import belongs_to
from roboxim_eval.experiments.proving.changes import changed_parts
from roboxim_eval.experiments.proving.delivery import faults_of
from roboxim_eval.experiments.proving.demand import Allowed, Demand, Shown, View
from roboxim_eval.experiments.proving.proofs import Tally, Trained, pairing, tally, training_tally

VIEW = View(parent="world", pose=Pose(position=(1.0, 0.2, 0.6)))


def words(*values):
    return Allowed(values=values)


DEMAND = Demand(
    skill="pick_up", models={"target": words("cube")}, modifiers={"target": {"color": words("red")}},
    distractors=(1, 2), others={"apple": {}, "cube": {"color": words("blue", "green")}},
    physics={"target": {"mass_kg": Allowed(lower=(0.05,), upper=(0.2,))}}, table_friction=words(0.7),
    templates=("Pick up the {target}", "Lift the {target}"),
    areas={"target": (Allowed(lower=(0.3, -0.1), upper=(0.5, 0.1)),)},
    start=Allowed(lower=(0.4, -0.1, 0.3), upper=(0.5, 0.1, 0.4)), cameras={"workspace": (VIEW,)},
    look={"light.intensity": Allowed(lower=(1.0,), upper=(4.0,)), "table.texture": words("marble", "wood")},
)  # fmt: skip
CLEAN = Shown(
    bag="episodes/eval-0", cell="pick_up target=cube", number=0, skill="pick_up", models={"target": "cube"},
    modifiers={"target": {"color": "red"}}, descriptions={"target": "red cube"},
    physics={"target": {"mass_kg": 0.08, "friction_coefficient": 0.8}}, weights={"target": 0.08}, table_friction=0.7,
    others={"distractor_1": "apple"}, other_modifiers={"distractor_1": {}}, positions={"target": (0.4, 0.0, 0.02)},
    start=(0.45, 0.0, 0.35), cameras={"workspace": VIEW}, look={"light.intensity": 2.0, "table.texture": "wood"},
    tool_px={"workspace": 0.0}, pixels={"target": 300.0, "distractor_1": 200.0},
    colors={"target": 0.5, "table": 0.2, "distractor_1": 0.1},
    brightness={"workspace": 0.1}, state_hash="a" * 32, pictures={"workspace": 7},
    thumbnails={"workspace": (100, 100)}, instruction="Pick up the red cube", received=("Pick up the red cube",),
)  # fmt: skip
DEMANDS = {CLEAN.cell: DEMAND}
NAN = float("nan")
GREY = (0.5, 0.5, 0.5)


def moved(metres):
    x, y, z = VIEW.pose.position
    return View(parent="world", pose=Pose(position=(x + metres, y, z)))


def test_a_clean_episode_passes_every_check():
    assert faults_of(DEMAND, CLEAN) == {}
    found = tally(DEMANDS, [CLEAN])
    assert set(found.checks.values()) == {(1, 1)}
    assert not found.refusal()


@pytest.mark.parametrize(
    ("check", "figure", "defect"),
    [
        ("skill", "rotate", {"skill": "rotate"}),
        ("object", "the target is apple", {"models": {"target": "apple"}}),
        ("object", "color of the target is blue", {"modifiers": {"target": {"color": "blue"}}}),
        ("object", "12 visible pixels", {"pixels": {"target": 12.0}}),
        ("object", "15.0 .CIEDE2000", {"colors": {"target": 15.0}}),
        ("distractors", "0 distractors .* 1 to 2 expected", {"others": {}, "pixels": {}, "colors": {}}),
        ("distractors", "distractor_1 is a lemon, .* apple or cube", {"others": {"distractor_1": "lemon"}}),
        ("distractors", "color of distractor_1 is none, .* blue or green", {"others": {"distractor_1": "cube"}}),
        ("distractors", "distractor_1's median colour is 15.0", {"colors": {"distractor_1": 15.0}}),
        (
            "physics",
            "mass_kg of the target is 0.4, .* from 0.05 to 0.2",
            {"physics": {"target": {"mass_kg": 0.4}}, "weights": {"target": 0.4}},
        ),
        ("physics", "0.04 kg of the target press on the table, its model has 0.08 kg", {"weights": {"target": 0.04}}),
        ("physics", "the table's friction is 0.5, .* 0.7", {"table_friction": 0.5}),
        (
            "instruction",
            "the cell demands 'Pick up the {target}' or 'Lift the {target}', where target is the red cube",
            {"instruction": "Pick up the blue cube", "received": ("Pick up the blue cube",)},
        ),
        ("area", "0.4 0.2 m, 10.0 cm outside", {"positions": {"target": (0.4, 0.2, 0.0)}}),
        ("area", "the target is missing", {"positions": {}}),
        ("start", "5.0 cm outside", {"start": (0.45, 0.0, 0.25)}),
        ("camera", "5.0 cm from the demanded pose", {"cameras": {"workspace": moved(0.05)}}),
        ("camera", "mounted on gripper", {"cameras": {"workspace": replace(VIEW, parent="gripper")}}),
        ("camera", "missing", {"cameras": {}}),
        ("camera", "4.0 px from its projection", {"tool_px": {"workspace": 4.0}}),
        ("camera", "is not found", {"tool_px": {"workspace": float("inf")}}),
        ("light", "light.intensity is 0.5, .* from 1 to 4", {"look": {**CLEAN.look, "light.intensity": 0.5}}),
        ("light", r"-9.0 of 255", {"brightness": {"workspace": -9.0}}),
        ("texture", "table.texture is none, .* marble or wood", {"look": {**CLEAN.look, "table.texture": ""}}),
        ("texture", "12.0", {"colors": {"table": 12.0}}),
        ("words", "received '', expected 'Pick up the red cube'", {"received": ("",)}),
        ("words", "received 'Pick up the red cube' and '', expected", {"received": ("Pick up the red cube", "")}),
    ],
)
def test_each_defect_is_found_with_its_figure(check, figure, defect):
    found = tally(DEMANDS, [CLEAN, replace(CLEAN, bag="episodes/eval-1", **defect)])
    (fault,) = found.faults
    assert (fault.check, fault.bag) == (check, "episodes/eval-1")
    with pytest.raises(RuntimeError, match=rf"1 of 2 episodes .*\n  episodes/eval-1: {check}: .*{figure}"):
        raise RuntimeError(found.refusal())


def test_hidden_distractors_are_stated_but_no_fault():
    """A scene guarantees the sight of the objects of its task alone."""
    found = tally(
        DEMANDS, [CLEAN, replace(CLEAN, bag="episodes/eval-1", pixels={**CLEAN.pixels, "distractor_1": 12.0})]
    )
    assert not found.faults
    (said,) = found.statements
    assert said.startswith("1 of 2 distractors are hidden or out of the picture: fewer than 40 visible pixels")


def test_pictures_that_nothing_compared_are_counted_and_stated_but_no_fault():
    photo = replace(CLEAN, bag="episodes/eval-1", not_compared="renderer photo", tool_px={}, pixels={}, colors={})
    found = tally(DEMANDS, [CLEAN, photo, photo])
    assert not found.faults
    assert found.checks["pictures"] == (1, 3)
    (said,) = found.statements
    assert said.startswith("pictures were not compared (renderer photo): where 'pictures' did not pass, camera")
    compared = tally(DEMANDS, [CLEAN])
    assert (compared.checks["pictures"], compared.statements) == ((1, 1), ())
    assert "pictures" not in tally(DEMANDS, [replace(CLEAN, pictures={})]).checks, "there are none to compare"


@pytest.mark.parametrize(
    ("check", "defect"),
    [
        ("skill", {"arguments": {"angle": NAN}}),
        ("object", {"modifiers": {"target": {"color": "red", "mass": NAN}}}),
        ("object", {"pixels": {"target": NAN}}),
        ("object", {"colors": {"target": NAN}}),
        ("distractors", {"pixels": {"distractor_1": NAN}}),
        ("physics", {"weights": {"target": NAN}}),
        ("physics", {"physics": {"target": {"mass_kg": NAN}}, "weights": {}}),
        ("physics", {"table_friction": NAN}),
        ("area", {"positions": {"target": (NAN, 0.0, 0.02)}}),
        ("area", {"positions": {"target": (0.4, NAN, 0.02)}}),
        ("start", {"start": (0.45, 0.0, NAN)}),
        ("camera", {"tool_px": {"workspace": NAN}}),
        ("light", {"look": {**CLEAN.look, "table.color": GREY, "light.intensity": NAN}}),
        ("light", {"brightness": {"workspace": NAN}}),
        ("texture", {"look": {**CLEAN.look, "table.color": (0.5, NAN, 0.5)}}),
        ("texture", {"colors": {"table": NAN}}),
        ("latency", {"latency_ticks": NAN}),
    ],
)
def test_a_nan_is_a_fault(check, defect):
    demand = replace(
        DEMAND, arguments={"angle": words(0.5, 1.0)},
        modifiers={"target": {"color": words("red"), "mass": Allowed(lower=(0.1,), upper=(0.2,))}},
        look={**DEMAND.look, "table.color": words(GREY)},
    )  # fmt: skip
    whole = replace(
        CLEAN, arguments={"angle": 0.5}, modifiers={"target": {"color": "red", "mass": 0.15}},
        look={**CLEAN.look, "table.color": GREY},
    )  # fmt: skip
    assert faults_of(demand, whole) == {}
    assert list(faults_of(demand, replace(whole, **defect))) == [check]


def test_a_policy_must_receive_the_words_of_its_condition():
    blind = replace(DEMAND, words="")
    assert "words" in faults_of(blind, CLEAN)
    assert not faults_of(blind, replace(CLEAN, received=("",)))
    assert "words" in faults_of(blind, replace(CLEAN, received=("", "Pick up the red cube"))), "one request had words"


def test_words_that_a_bag_does_not_tell_are_unproven_and_said_to_be():
    silent = replace(CLEAN, bag="episodes/old", received=())
    found = tally(DEMANDS, [CLEAN, silent])
    assert found.checks["words"] == (1, 1)
    assert found.checks["instruction"] == (2, 2)
    assert "the bags of 1 of 2 rollouts do not say which instruction the policy received" in found.statements[0]
    demonstrations = tally(DEMANDS, [silent], without=("words",))
    assert "words" not in demonstrations.checks
    assert demonstrations.statements == ()
    assert tally(DEMANDS, [silent]).checks.keys().isdisjoint({"words"})


@pytest.mark.parametrize("said", ["Lift the red cube", "Lift the top drawer of the red cube"])
def test_an_instruction_follows_a_template_of_its_cell(said):
    assert not faults_of(DEMAND, replace(CLEAN, instruction=said, received=(said,)))
    angle = replace(DEMAND, templates=("Turn the {target} {direction} by {angle} degrees",))
    turning = "Turn the red cube clockwise by 90 degrees"
    assert not faults_of(angle, replace(CLEAN, instruction=turning, received=(turning,)))
    assert "instruction" in faults_of(angle, replace(CLEAN, instruction=said, received=(said,)))


def test_distractors_that_every_scene_has_must_be_there():
    demand = replace(DEMAND, always=("cube",), distractors=(2, 2))
    two = replace(
        CLEAN, others={"distractor_1": "cube", "distractor_2": "cube"},
        other_modifiers={"distractor_1": {}, "distractor_2": {"color": "blue"}},
    )  # fmt: skip
    assert not faults_of(demand, two)
    apple = replace(two, others={"distractor_1": "apple", "distractor_2": "cube"})
    assert faults_of(demand, apple) == {"distractors": "no distractor is a cube, which every scene has"}


def test_a_drawn_camera_must_lie_within_its_range():
    shifted = replace(DEMAND, shifts={"workspace": Allowed(lower=(-0.06, -0.1, 0.0), upper=(0.06, 0.1, 0.0))})
    assert not faults_of(shifted, replace(CLEAN, cameras={"workspace": moved(0.05)}))
    assert "9.0 cm from" not in str(faults_of(shifted, replace(CLEAN, cameras={"workspace": moved(0.09)})))
    assert "3.0 cm from" in str(faults_of(shifted, replace(CLEAN, cameras={"workspace": moved(0.09)})))


def test_one_percent_of_faulty_episodes_is_tolerated_and_no_more():
    bad = replace(CLEAN, others={})
    few = tally(DEMANDS, [CLEAN] * 199 + [replace(bad, bag=f"b{n}") for n in range(2)])
    assert few.faulty == {"b0", "b1"}
    assert not few.refusal()
    many = few + tally(DEMANDS, [replace(bad, bag="b2")])
    assert "3 of 202 episodes" in many.refusal()
    assert "2 of 201" in few.refusal(0.0)


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


# ------------------------------------------------------------------ training data

ROTATE = replace(DEMAND, skill="rotate", distractors=(0, 0))
CELLS = {"pick_up target=cube": DEMAND, "rotate target=cube": ROTATE}
TURN = Trained(shown=replace(CLEAN, bag="episodes/demo-1", cell="rotate target=cube", skill="rotate"))


def trained_on(*episodes, counts=None):
    return training_tally(CELLS, ["pick_up target=cube"], counts or {"rotate target=cube": len(episodes)}, episodes)


def test_a_held_out_episode_is_found_whatever_cell_it_claims():
    assert not trained_on(TURN, TURN).refusal(0.0)
    lying = Trained(shown=replace(CLEAN, bag="episodes/demo-2", cell="rotate target=cube"))
    refusal = trained_on(TURN, lying).refusal(0.0)
    assert "episodes/demo-2: unseen: it is of the held-out cell 'pick_up target=cube', although it claims" in refusal
    both = {"pick_up target=cube": 1, "rotate target=cube": 1}
    assert not trained_on(TURN, Trained(shown=CLEAN), counts=both).refusal(0.0), "the baseline may have it"


BRIGHT = replace(DEMAND, look={**DEMAND.look, "light.intensity": Allowed(lower=(2.5,), upper=(4.0,))})
FACTORS = {
    "light": (BRIGHT, {"look": {**CLEAN.look, "light.intensity": 3.0}}),
    "texture": (
        replace(DEMAND, look={**DEMAND.look, "table.texture": words("speckle")}),
        {"look": {**CLEAN.look, "table.texture": "speckle"}},
    ),
    "start": (
        replace(DEMAND, start=Allowed(lower=(0.4, 0.2, 0.3), upper=(0.5, 0.3, 0.4))), {"start": (0.45, 0.25, 0.35)},
    ),
    "distractors": (
        replace(DEMAND, distractors=(0, 0), others={}), {"others": {}, "other_modifiers": {}, "pixels": {}},
    ),
    "physics": (
        replace(DEMAND, physics={"target": {"mass_kg": Allowed(lower=(0.3,), upper=(0.5,))}}),
        {"physics": {"target": {"mass_kg": 0.4, "friction_coefficient": 0.8}}, "weights": {"target": 0.4}},
    ),
    "instruction": (
        replace(DEMAND, templates=("Grasp the {target}",)),
        {"instruction": "Grasp the red cube", "received": ("Grasp the red cube",)},
    ),
}  # fmt: skip
"""Property to what another level of it demands of a cell that is DEMAND otherwise, and what its episodes show."""
NOMINAL = replace(DEMAND, look={**DEMAND.look, "light.intensity": words(2.0)})
USUAL = Trained(shown=replace(CLEAN, cell="usual"))


def held_out_by(factor, *episodes):
    cells = {"usual": NOMINAL, "other": FACTORS[factor][0]}
    return training_tally(cells, ["other"], {"usual": len(episodes)}, episodes)


@pytest.mark.parametrize("factor", FACTORS)
def test_a_held_out_light_start_or_word_is_told_from_the_seen_one(factor):
    assert held_out_by(factor, USUAL).faults == ()
    shown = replace(CLEAN, cell="other", bag="episodes/other", **FACTORS[factor][1])
    assert faults_of(FACTORS[factor][0], shown) == {}
    lying = Trained(shown=replace(shown, cell="usual"))
    (fault,) = held_out_by(factor, USUAL, lying).faults
    assert (fault.check, fault.bag) == ("unseen", "episodes/other")
    assert fault.text == "it is of the held-out cell 'other', although it claims 'usual'"
    said = held_out_by(factor, USUAL, Trained(shown=shown)).refusal(0.0)
    assert "episodes/other: unseen: it is of the held-out cell 'other'" in said


def test_a_held_out_episode_with_a_fault_or_other_words_is_still_one():
    dark = replace(CLEAN, cell="usual", **FACTORS["light"][1])
    for defect in ({"instruction": "Rotate the red cube"}, {"brightness": {"workspace": 90.0}}, {"others": {}}):
        planted = Trained(shown=replace(dark, **defect), planted="a fault that excuses it from the other checks")
        assert held_out_by("light", planted).refusal(0.0), defect
    reworded = Trained(shown=replace(CLEAN, cell="rotate target=cube", instruction="Rotate the red cube"))
    assert trained_on(reworded).refusal(0.0), "skills tell these cells apart, not words"


def test_a_light_of_neither_cell_is_a_fault_of_the_light_alone():
    between = Trained(shown=replace(CLEAN, cell="usual", look={**CLEAN.look, "light.intensity": 2.3}))
    assert held_out_by("light", between).faults == ()
    assert list(faults_of(NOMINAL, between.shown)) == ["light"]


def test_the_counts_of_a_dataset_must_be_those_of_the_design():
    refusal = trained_on(TURN, TURN, counts={"rotate target=cube": 3}).refusal(0.0)
    assert "rotate target=cube: counts: 2 episodes, 3 expected" in refusal


def test_answers_must_be_as_late_as_the_condition_says():
    late = replace(DEMAND, latency_ticks=2)
    assert faults_of(late, replace(CLEAN, latency_ticks=2.0)) == {}
    assert faults_of(late, CLEAN) == {"latency": "the policy's answers were 0 ticks late, 2 expected"}
    assert faults_of(DEMAND, replace(CLEAN, latency_ticks=1.5)) != {}


def test_held_out_objects_beside_the_target_and_in_words_are_stated():
    beside = Trained(
        shown=replace(CLEAN, models={"target": "apple"}, others={"distractor_1": "cube"}, cell="rotate target=cube")
    )
    asked = Demand(skill="pick_up", models={"target": words("cube")})
    found = trained_on(beside, replace(TURN, instructed=(asked,)))
    assert not found.refusal(0.0)
    assert found.statements == (
        "1 of 1 training episodes of pick_up have the object of the held-out cell 'pick_up target=cube' as a "
        "distractor",
        "the instructions of 1 training episodes ask for the held-out cell 'pick_up target=cube'",
    )


def test_words_of_the_own_cell_are_no_exposure_of_a_cell_with_other_surroundings():
    elsewhere = replace(DEMAND, areas={"target": (Allowed(lower=(0.3, 0.2), upper=(0.5, 0.3)),)})
    asked = Demand(skill="pick_up", models={"target": words("cube")})
    episode = Trained(shown=replace(CLEAN, cell="picks right"), instructed=(asked,))
    assert (
        training_tally({"picks left": elsewhere, "picks right": DEMAND}, ["picks left"], {}, [episode]).statements == ()
    )


def test_cells_are_told_apart_by_content():
    assert belongs_to(DEMAND, CLEAN)
    assert not belongs_to(ROTATE, CLEAN)
    assert not belongs_to(DEMAND, replace(CLEAN, cameras={"workspace": moved(0.3)}))
