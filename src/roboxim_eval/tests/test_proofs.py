"""Proofs of delivery: each planted defect is found, by name of its bag and with its figure; a clean episode passes."""

from dataclasses import replace

import pytest

from roboxim_core.poses import Pose
from roboxim_eval.experiments.delivery import Allowed, Demand, Shown, View, belongs_to, faults_of
from roboxim_eval.experiments.proofs import Tally, Trained, pairing, tally, training_tally

VIEW = View(parent="world", pose=Pose(position=(1.0, 0.2, 0.6)))


def words(*values):
    return Allowed(values=values)


DEMAND = Demand(
    skill="pick_up", models={"target": words("cube")}, modifiers={"target": {"color": words("red")}},
    distractors=(1, 2), areas={"target": (Allowed(lower=(0.3, -0.1), upper=(0.5, 0.1)),)},
    start=Allowed(lower=(0.4, -0.1, 0.3), upper=(0.5, 0.1, 0.4)), cameras={"workspace": (VIEW,)},
    look={"light.intensity": Allowed(lower=(1.0,), upper=(4.0,)), "table.texture": words("marble", "wood")},
)  # fmt: skip
CLEAN = Shown(
    bag="episodes/eval-0", cell="pick_up target=cube", number=0, skill="pick_up", models={"target": "cube"},
    modifiers={"target": {"color": "red"}}, others=("apple",), positions={"target": (0.4, 0.0, 0.02)},
    start=(0.45, 0.0, 0.35), cameras={"workspace": VIEW}, look={"light.intensity": 2.0, "table.texture": "wood"},
    tool_px={"workspace": 0.0}, pixels={"target": 300.0}, colors={"target": 0.5, "table": 0.2},
    brightness={"workspace": 0.1}, state_hash="a" * 32, pictures={"workspace": 7},
    thumbnails={"workspace": (100, 100)}, instruction="Pick up the red cube", received="Pick up the red cube",
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
        ("distractors", "0 distractors .* 1 to 2 expected", {"others": ()}),
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
        ("words", "received '', expected 'Pick up the red cube'", {"received": ""}),
    ],
)
def test_each_defect_is_found_with_its_figure(check, figure, defect):
    found = tally(DEMANDS, [CLEAN, replace(CLEAN, bag="episodes/eval-1", **defect)])
    (fault,) = found.faults
    assert (fault.check, fault.bag) == (check, "episodes/eval-1")
    with pytest.raises(RuntimeError, match=rf"1 of 2 episodes .*\n  episodes/eval-1: {check}: .*{figure}"):
        raise RuntimeError(found.refusal())


@pytest.mark.parametrize(
    ("check", "defect"),
    [
        ("skill", {"arguments": {"angle": NAN}}),
        ("object", {"modifiers": {"target": {"color": "red", "mass": NAN}}}),
        ("object", {"pixels": {"target": NAN}}),
        ("object", {"colors": {"target": NAN}}),
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
    assert not faults_of(blind, replace(CLEAN, received=""))


def test_a_drawn_camera_must_lie_within_its_range():
    shifted = replace(DEMAND, shifts={"workspace": Allowed(lower=(-0.06, -0.1, 0.0), upper=(0.06, 0.1, 0.0))})
    assert not faults_of(shifted, replace(CLEAN, cameras={"workspace": moved(0.05)}))
    assert "9.0 cm from" not in str(faults_of(shifted, replace(CLEAN, cameras={"workspace": moved(0.09)})))
    assert "3.0 cm from" in str(faults_of(shifted, replace(CLEAN, cameras={"workspace": moved(0.09)})))


def test_one_percent_of_faulty_episodes_is_tolerated_and_no_more():
    bad = replace(CLEAN, others=())
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
    assert pairing({"a": [CLEAN], "camera": [lit]}, {"camera": ["reset.cameras"]}) == Tally(), "redrawn scenes"
    arms = arms_of(3, a={"state_hash": "b" * 32, "thumbnails": {"workspace": (104, 100)}}) | {"light": [lit]}
    assert pairing(arms, changed).faulty == {"episodes/a"}, "the light is compared with the majority"


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


def test_the_counts_of_a_dataset_must_be_those_of_the_design():
    refusal = trained_on(TURN, TURN, counts={"rotate target=cube": 3}).refusal(0.0)
    assert "rotate target=cube: counts: 2 episodes, 3 expected" in refusal


def test_answers_must_be_as_late_as_the_condition_says():
    late = replace(DEMAND, latency_ticks=2)
    assert faults_of(late, replace(CLEAN, latency_ticks=2.0)) == {}
    assert faults_of(late, CLEAN) == {"latency": "the policy's answers were 0 ticks late, 2 expected"}
    assert faults_of(DEMAND, replace(CLEAN, latency_ticks=1.5)) != {}


def test_held_out_objects_beside_the_target_and_in_words_are_stated():
    beside = Trained(shown=replace(CLEAN, models={"target": "apple"}, others=("cube",), cell="rotate target=cube"))
    asked = Demand(skill="pick_up", models={"target": words("cube")})
    found = trained_on(beside, replace(TURN, asked=(asked,)))
    assert not found.refusal(0.0)
    assert found.statements == (
        "1 of 1 training episodes of pick_up have the object of the held-out cell 'pick_up target=cube' as a "
        "distractor",
        "the instructions of 1 training episodes ask for the held-out cell 'pick_up target=cube'",
    )


def test_words_of_the_own_cell_are_no_exposure_of_a_cell_with_other_surroundings():
    elsewhere = replace(DEMAND, areas={"target": (Allowed(lower=(0.3, 0.2), upper=(0.5, 0.3)),)})
    asked = Demand(skill="pick_up", models={"target": words("cube")})
    episode = Trained(shown=replace(CLEAN, cell="picks right"), asked=(asked,))
    assert (
        training_tally({"picks left": elsewhere, "picks right": DEMAND}, ["picks left"], {}, [episode]).statements == ()
    )


def test_cells_are_told_apart_by_content():
    assert belongs_to(DEMAND, CLEAN)
    assert not belongs_to(ROTATE, CLEAN)
    assert not belongs_to(DEMAND, replace(CLEAN, cameras={"workspace": moved(0.3)}))
