"""Physics steps per second on one core, without rendering: five objects and the cabinet.

- ``bare``: PyBullet alone;
- ``observed``: adds the arm's targets, and the contacts and joint extremes of every step;
- ``ticks``: whole ticks with controller, physics, state record and its hash, while arm and gripper move.
"""

import time

import numpy as np
from benchmarks._harness import Bench

from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_sim.world import World

MODELS = ("cube", "apple", "soda_can", "cucumber", "plate")
ROUNDS = 5


def main() -> None:
    """Measure and print."""
    bench = Bench("physics", __doc__)
    ticks = 40 if bench.quick else 200
    library = ModelLibrary()
    best: dict[str, float] = {}
    with World(library) as world:
        world.load(scene(library), "e")
        steps = ticks * world.steps_per_tick
        client = world.physics.client

        def bare() -> None:
            for _ in range(steps):
                client.stepSimulation()

        def observed() -> None:
            world.physics.begin_tick()
            world.physics.advance(steps, world.record.robot.joint_commands)

        def whole() -> None:
            for k in range(ticks):
                action = [0.005 * np.sin(0.3 * k), 0.005 * np.cos(0.3 * k), 0.0, 0.0, 0.0, 0.01, float(k // 10 % 2)]
                world.tick(world.record.seq + 1, action)

        for _ in range(ROUNDS):
            for name, run in (("bare", bare), ("observed", observed), ("ticks", whole)):
                before = time.perf_counter()
                run()
                best[name] = max(best.get(name, 0.0), steps / (time.perf_counter() - before))
    for name, rate in best.items():
        bench.row(what=name, steps_per_s=round(rate), faster_than_real_time=round(rate / 240.0, 1))
    bench.finish("physics steps per second, observed", best["observed"], "1/s", at_least=4500)


def scene(library: ModelLibrary) -> SceneSpec:
    """Return a scene with the objects and the cabinet on the table."""
    cabinet = EntitySpec(name="cabinet", model="cabinet", fixed=True,
                         pose=Pose(position=(0.78, 0.25, library.object("cabinet").rest_height)))  # fmt: skip
    places = [(0.35, -0.3), (0.45, -0.15), (0.6, -0.3), (0.6, 0.0), (0.4, 0.2)]
    objects = [
        EntitySpec(name=model, model=model, pose=Pose(position=(x, y, library.object(model).rest_height)))
        for model, (x, y) in zip(MODELS, places, strict=True)
    ]
    return SceneSpec(entities=(cabinet, *objects))


if __name__ == "__main__":
    main()
