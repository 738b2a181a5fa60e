"""An episode in which everything that its cell demands was delivered."""

from roboxim_core.poses import Pose
from roboxim_eval.experiments.proving.demand import Allowed, Demand, Shown, View

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


def moved(metres):
    x, y, z = VIEW.pose.position
    return View(parent="world", pose=Pose(position=(x + metres, y, z)))
