"""The shipped experiments, what scales change in them, and what their cards attest."""

import os
import platform
import shlex
import subprocess
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import pytest
from planted_cards import experiment_of

from roboxim_bringup.parameters import parse_options
from roboxim_core.config import named_config, to_plain
from roboxim_core.config_folders import config_names
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import design_of, scale_names, stages_of
from roboxim_eval.experiments.reductions import deciding
from roboxim_runs.experiments.definitions import definitions
from roboxim_runs.experiments.files import (
    benchmark_experiments,
    checked_design,
    fitted_experiment,
    known_as,
    load_benchmark,
    load_experiment,
    mixes,
    write_experiment,
    write_mixes,
)
from roboxim_runs.experiments.provenance import Attestations, device, packages_sha256
from roboxim_runs.experiments.trained.policies import require_trainers_policy
from roboxim_runs.training.run import BCConfig, read_config
from roboxim_tasks.config import load_task_config, task_mix


@pytest.mark.parametrize("name", config_names("experiments"))
def test_every_shipped_experiment_is_valid_at_every_scale(name):
    assert scale_names(load_experiment(name)) == ("smoke", "laptop", "night", "full")
    for scale in ("smoke", "laptop", "night", "full"):
        checked_design(name, load_experiment(name, scale))


HELD_OUT = """
about: Does a policy act where one property is as it never was?
factors: {{task: {tasks}, setting: {{usual: {usual}, other: {other}}}}}
unseen: [{unseen}]
datasets: {{leave_out: {{cells: seen, per_cell: 1}}}}
conditions: {{leave_out: {{train: leave_out}}}}
trainers: {{external: {{}}}}
evaluate: {{per_cell: 1}}
replicates: {{count: 1}}
"""


def held_out(other, usual="{}", tasks="[pick_cube]", unseen="{setting: other}"):
    return checked_design("mine", experiment_of(HELD_OUT.format(other=other, usual=usual, tasks=tasks, unseen=unseen)))


@pytest.mark.parametrize(
    "other",
    [
        "{reset: {lights: {intensity: {values: [1.0]}}}}",
        "{reset: {lights: {direction: {values: [[0.5, 0.5, -1.0]]}}}}",
        "{reset: {lights: {lamps: {number: {values: [1, 2]}}}}}",
        "{reset: {surfaces: {table: {texture: {values: [marble]}}}}}",
        "{reset: {background: {kind: {values: [plain]}}}}",
        "{reset: {robot: {position: {lower: [0.41, 0.1, 0.26], upper: [0.53, 0.2, 0.38]}}}}",
        "{reset: {cameras: {exposure_ev: {workspace: {values: [-1.0, 1.0]}}}}}",
        "{reset: {physics: {table_friction: {values: [0.5]}, objects: {}, distractors: {}}}}",
        "{objects: {target: {modifiers: {mass: {values: [0.5, 2.0]}}}}}",
        "{distractors: {minimum: 1, maximum: 3}}",
        "{templates: {values: ['Grasp the {target}']}}",
        "{scene: kitchen}",
    ],
)
def test_any_property_that_bags_show_may_be_held_out(other):
    assert len(held_out(other).cells) == 2
    assert held_out(other, unseen="{setting: usual}").datasets == {"leave_out": {"pick_cube setting=other": 1}}


def test_two_tasks_of_one_skill_may_be_told_apart_by_their_distractors():
    design = held_out("{max_steps: 50}", tasks="[pick_cube, pick_cube_distractors]", unseen="{task: pick_cube}")
    assert len(design.datasets["leave_out"]) == 2


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ("{max_steps: 50}", "differ in nothing that bags show"),
        ("{reset: {objects: {yaw_rad: {values: [0.0]}}}}", "differ in nothing that bags show"),
        ("{reset: {lights: {intensity: {lower: 1.0, upper: 4.0}}}}", "differ in light, but may share values there"),
        ("{distractors: {minimum: 0, maximum: 3}}", "differ in distractors, but may share values there"),
        ("{templates: {values: ['Pick up the {target}', 'Grasp the {target}']}}", "differ in instruction, but may"),
        ("{objects: {target: {modifiers: {mass: {lower: 0.5, upper: 2.0}}}}}", "differ in object, but may"),
    ],
)
def test_held_out_cells_that_no_proof_can_tell_from_seen_ones_are_refused(other, said):
    with pytest.raises(ConfigError) as error:
        held_out(other)
    text = str(error.value)
    cells = "the held-out cell 'pick_cube setting=other' and the cell 'pick_cube setting=usual' of dataset 'leave_out'"
    assert f"experiment 'mine': {cells} {said}" in text
    assert "expected values that exclude each other in at least one of skill, arm, object, physics, " in text
    assert "hold both of them out or none in unseen" in text


@pytest.mark.parametrize(
    ("name", "datasets", "demonstrations", "trainings", "scenes"),
    [
        ("pick_cube", {"cube": 200}, 200, 1, 0),
        ("pick_cube_axes", {"converted": 200, "unity": 200}, 200, 2, 50),
        ("colors", {"all": 400}, 400, 5, 80),
        ("objects", {"all": 600}, 600, 5, 120),
        ("skills", {"all": 500}, 500, 5, 100),
        ("cross_domain", {"four_objects": 400}, 400, 2, 40),
        ("area", {"leave_out": 300}, 300, 5, 50),
        ("camera", {"leave_out": 300}, 300, 5, 50),
        ("skill_object", {"leave_out": 324, "baseline": 324}, 432, 10, 120),
        ("camera_object", {"leave_out": 324, "baseline": 324}, 432, 10, 120),
        ("camera_skill", {"leave_out": 306, "baseline": 306}, 408, 10, 60),
    ],
)
def test_the_experiments_of_the_thesis_have_its_counts(name, datasets, demonstrations, trainings, scenes):
    design = design_of(load_experiment(name))
    assert {key: sum(counts.values()) for key, counts in design.datasets.items()} == datasets
    assert (design.episodes, len(design.trainings)) == (demonstrations, trainings)
    assert design.compared_scenes == scenes


def test_the_arms_of_embodiment_lack_one_skill_each_and_its_definitions_name_all_of_them():
    design = design_of(load_experiment("embodiment"))
    held_out = [(cell.levels["arm"], cell.levels["task"]) for cell in design.cells if cell.unseen]
    arms = {"panda", "fr3", "xarm7", "iiwa14", "gen3"}
    assert {key: sum(counts.values()) for key, counts in design.datasets.items()} == {"leave_out": 450, "baseline": 450}
    assert (len(held_out), {arm for arm, _ in held_out}) == (5, arms)
    seen = [(cell.levels["arm"], cell.levels["task"]) for cell in design.cells if not cell.unseen]
    assert {arm for arm, _ in seen} == arms
    assert {f"model {arm}" for arm in arms} <= definitions(design).keys()


def test_each_gripper_lacks_one_skill_that_the_other_has():
    design = design_of(load_experiment("gripper"))
    held_out = {cell.levels["gripper"]: cell.levels["task"] for cell in design.cells if cell.unseen}
    assert held_out == {"franka_hand": "place_on", "robotiq_2f85": "pick_up"}
    assert {key: sum(counts.values()) for key, counts in design.datasets.items()} == {"leave_out": 360, "baseline": 360}
    assert {"model panda", "model panda_2f85"} <= definitions(design).keys()


def test_the_cells_of_length_have_tasks_of_so_many_steps():
    design = design_of(load_experiment("length"))
    assert {key: sum(counts.values()) for key, counts in design.datasets.items()} == {"leave_out": 270, "baseline": 270}
    assert {cell.levels["length"] for cell in design.cells if cell.unseen} == {"2", "3", "4"}
    mix = task_mix(next(iter(mixes(design).values())))
    lengths = {key: len(cell.steps) for key, cell in zip(mix.keys, mix.cells, strict=True)}
    assert all(f"length={number}" in key for key, number in lengths.items())
    assert set(lengths.values()) == {2, 3, 4}


def test_the_axes_of_pick_cube_differ_in_training_and_bc_is_refused_there(tmp_path):
    design = design_of(load_experiment("pick_cube_axes"))
    stages = {stage.name: stage for stage in stages_of(design)}
    trained, other = stages["train/converted.0"], stages["train/unity_axes.0"]
    assert trained.sha != other.sha
    assert stages[other.needs[0]].inputs["options"] == {"convention": "unity"}
    file = tmp_path / "mine.yaml"
    file.write_text("{command: 'roboxim train bc {dataset} --out {out} --seed {seed} --steps {steps}', policy: bc}")
    with pytest.raises(ConfigError, match="export: 'roboxim train bc .*cannot learn from convention 'roboxim'"):
        load_experiment("pick_cube_axes", trainer=str(file))
    with pytest.raises(ConfigError, match="uses convention 'octo_finetuned', regardless of its training"):
        load_experiment("pick_cube_axes", trainer="octo")
    assert load_experiment("pick_cube_axes", trainer="smolvla").trainers["smolvla"].steps == 20000


def test_a_trainers_file_is_known_by_its_name_wherever_it_lies(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = "{command: 'train {dataset} {out} {seed} {steps}', policy: bc}"
    for name in ("mine.yaml", "bc.yaml"):
        Path(name).write_text(text)
    ways = [
        load_experiment("skill_object", "laptop", trainer=way) for way in ("mine.yaml", str(tmp_path / "mine.yaml"))
    ]
    assert to_plain(ways[0]) == to_plain(ways[1])
    assert checked_design("skill_object", ways[0], "./mine.yaml").trainer.command.startswith("train ")
    with pytest.raises(ConfigError, match="another trainer 'bc'; give the file another name"):
        load_experiment("skill_object", "laptop", trainer="bc.yaml")


@pytest.mark.parametrize("name", config_names("trainers"))
def test_every_shipped_trainer_is_valid(name):
    config = load_experiment("skill_object", "laptop", trainer=name)
    design = checked_design("skill_object", config, name)
    require_trainers_policy(design.trainer)
    assert design.trainer.steps == 4000, "those of the experiment, since the file names none"
    given = dict.fromkeys(("dataset", "checkpoint", "out", "condition", "replicate", "seed", "steps"), "there")
    for text in filter(None, (design.trainer.command, design.trainer.serve)):
        words = [word.format(**given) for word in shlex.split(text)]
        if design.trainer.is_own:
            read_config(
                words[2], None, parse_options([words[i + 1] for i, word in enumerate(words) if word == "--set"])
            )
            continue
        assert words[:2] == ["sh", "-c"]
        subprocess.run(["sh", "-n", "-c", words[2]], check=True)


def test_octo_is_fine_tuned_in_whole_or_its_head_alone(tmp_path):
    config = load_experiment("cross_domain", "laptop", trainer="octo")
    given = {"dataset": "data", "out": str(tmp_path / "out"), "seed": 0, "steps": 5}
    environment = {**os.environ, "OCTO_PYTHON": "echo", "OCTO_SOURCE": "octo dlimp", "OCTO_CONFIG": "config.py"}
    for arguments, config_flag in (("", "full"), ("full", "full"), ("head_only", "head_only")):
        words = [word.format(**given) for word in shlex.split(f"{config.trainers['octo'].command} {arguments}")]
        said = subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stdout
        assert f"octo/scripts/finetune.py --debug --config=config.py:{config_flag},language_conditioned " in said
    recipes = [training.arguments for training in checked_design("cross_domain", config, "octo").trainings]
    assert recipes == ["full", "head_only"]
    with pytest.raises(ConfigError, match="arguments are for octo alone, so trainer 'smolvla'"):
        checked_design("cross_domain", load_experiment("cross_domain", trainer="smolvla"), "smolvla")


def test_what_a_scale_changes_is_among_the_deviations(tmp_path):
    def stated(name, scale, **chosen):
        return load_experiment(name, scale, **chosen).deviations[-1]

    assert stated("skill_object", "laptop") == (
        "Scale laptop: trainers.bc.steps 4,000 instead of 10,000; evaluate.per_cell 5 instead of 20; "
        "replicates.count 3 instead of 5."
    ), "held-out cells have 20 rollouts at both"
    assert "without factors.task.rotate; factors.target cube, soda_can instead of cube, apple, soda_can" in (
        stated("skill_object", "smoke")
    )
    assert "; unseen 2 instead of 6 entries; " in stated("skill_object", "smoke")
    assert stated("area", "laptop").endswith("; without curve.")
    assert "per_cell 5 instead of 20; replicates" in stated("bc_ablation", "laptop"), "which has no held-out cells"
    assert "conditions.long.steps 4,000 instead of 100,000" in stated("pick_cube", "laptop")
    assert "Scale full" not in stated("skill_object", "full")
    assert "steps" not in stated("skill_object", "laptop", trainer="external"), "which trains as long"
    assert "trainers.octo.steps 4,000 instead of 10,000" in stated("skill_object", "laptop", trainer="octo")
    for name in config_names("experiments"):
        for scale in ("smoke", "laptop", "night"):
            said = stated(name, scale)
            assert said.startswith(f"Scale {scale}: ") or to_plain(load_experiment(name, scale)) == to_plain(
                load_experiment(name)
            ), (name, scale)
    at_night = benchmark_experiments(load_benchmark("transfer"), "night")["skill_object"]
    for said in ("trainers.bc.steps 8,000 instead of 10,000", "evaluate.cells.baseline unseen instead of all",
                 "replicates.count 3 instead of 5", "compare 2 instead of 3 entries"):  # fmt: skip
        assert said in at_night.deviations[-1]
    write_experiment(at_night, tmp_path / "mine.yaml")
    assert load_experiment(str(tmp_path / "mine.yaml")).deviations == at_night.deviations
    for name in ("mine", "mine.json", ".yaml"):  # names of experiments, to `experiment run`
        with pytest.raises(ConfigError, match=f"must end in .yaml, got .*{name}; e.g. .*{name}.yaml"):
            write_experiment(at_night, tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


def test_an_experiment_whose_stages_would_refuse_their_episodes_is_refused_before_it_is_planned():
    config = load_experiment("skill_object", "laptop")
    data = {name: replace(one, per_cell=10**6) for name, one in config.datasets.items()}
    with pytest.raises(ConfigError, match="has 18000000 demonstrations, at most 10000000 are allowed"):
        checked_design("mine", replace(config, datasets=data))
    with pytest.raises(ConfigError, match="has 120000120 rollouts of 'leave_out', at most 10000000"):
        checked_design("mine", replace(config, evaluate=replace(config.evaluate, per_cell=10**7)))


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("skill_object", "skill_object"),
        ("experiment", "experiment"),
        ("mine/round1.yaml", "round1"),
        ("docs/results/bc_uneven-laptop/experiment.yaml", "bc_uneven-laptop"),
        ("experiment.yaml", "experiment"),
        ("../experiment.yaml", "experiment"),
    ],
)
def test_an_experiment_whose_file_is_called_so_is_known_by_its_folder(name, known):
    assert known_as(name) == known


def test_what_a_budget_chose_is_among_the_deviations():
    config = load_experiment("skill_object", "laptop")
    chosen = replace(config, replicates=replace(config.replicates, count=4))
    found = fitted_experiment("skill_object", "laptop", chosen)
    assert len(found.deviations) == len(config.deviations)
    assert found.deviations[-1].startswith("Scale laptop in a budget: ")
    assert "replicates.count 4 instead of 5" in found.deviations[-1]


def test_arguments_may_name_a_trainer_by_the_name_of_its_file(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("{command: 'train {dataset} {out} {seed} {steps}', policy: bc}")
    with pytest.raises(ConfigError, match="arguments are for octo alone, so trainer 'mine'"):
        checked_design("cross_domain", load_experiment("cross_domain", trainer=str(file)), str(file))
    text = named_config("experiments", "cross_domain").read_text()
    own = tmp_path / "own.yaml"
    own.write_text(text.replace("octo: full", "mine: -a").replace("octo: head_only", "mine: -b"))
    design = checked_design("own", load_experiment(str(own), trainer=str(file)), str(file))
    assert [training.arguments for training in design.trainings] == ["-a", "-b"]


@pytest.mark.parametrize("name", [name for name in config_names("experiments") if name.endswith("_workspace_only")])
def test_a_sibling_without_a_wrist_camera_differs_in_that_alone(name):
    def whole(name):
        plain = deciding(load_experiment(name))
        plain["set"].setdefault("reset", {})
        return plain

    sibling, original = whole(name), whole(name.removesuffix("_workspace_only"))
    assert sibling["set"]["reset"].pop("cameras") == {"names": ["workspace"]}
    assert sibling == original


def test_datasets_are_balanced_over_the_levels_of_both_factors():
    for name in ("skill_object", "camera_object", "camera_skill"):
        design = design_of(load_experiment(name))
        for counts in design.datasets.values():
            for factor in design.config.dimensions:
                by_level = {}
                for cell in design.cells:
                    level = cell.levels[factor]
                    by_level[level] = by_level.get(level, 0) + counts.get(cell.key, 0)
                assert len(set(by_level.values())) == 1, (name, factor, by_level)


def test_the_triple_experiment_saw_no_two_of_the_three_together():
    design = design_of(load_experiment("triple"))
    seen = [set(cell.levels.values()) for cell in design.cells if not cell.unseen]
    held_out = [set(cell.levels.values()) for cell in design.cells if cell.unseen]
    assert len(held_out) == 3
    assert all(len(one & other) < 2 for one in held_out for other in seen)
    assert {frozenset(set().union(*seen))} == {frozenset(set().union(*held_out))}, "but each of them alone"


def test_the_mixes_are_files_for_generate_and_evaluate(tmp_path):
    design = design_of(load_experiment("camera_skill_worded", "smoke"))
    paths = write_mixes(design, tmp_path)
    names = {path.stem: load_task_config(str(path)) for path in paths}
    assert names["demonstrations"].seed_by == "cell"
    assert sum(names["dataset_leave_out"].counts) == 12
    assert set(names["evaluate_blind"].keys) == {"pick_up camera=right", "place_on camera=front"}


def test_worded_scenes_could_have_each_instruction():
    from roboxim_core.models.library import ModelLibrary
    from roboxim_core.seeds import SeedPath
    from roboxim_tasks.sampling.episodes import EpisodeGenerator

    generator = EpisodeGenerator(ModelLibrary())
    design = design_of(load_experiment("skill_object_worded"))
    mix = task_mix(mixes(design)["demonstrations"])
    for index in range(0, 18, 3):
        task = generator.draw(SeedPath(run_seed=1, purpose="demo", index=index), mix).task
        models = [thing.model for thing in task.objects.values()]
        assert models.count("plate") == 1
        assert len(models) == 4


def test_what_a_condition_adds_to_the_training_is_attested(tmp_path):
    said = Attestations.of(tmp_path, design_of(load_experiment("bc_ablation", "laptop")))
    recipes = [said.training(f"{name}.0", steps=3000, dataset_sha256="").recipe for name in ("base", "deeper")]
    assert [recipe["arguments"] for recipe in recipes] == ["none", "--set depth=2"]
    plain = Attestations.of(tmp_path, design_of(load_experiment("skill_object", "laptop")))
    assert "arguments" not in plain.training("baseline.0", steps=3000, dataset_sha256="").recipe


def test_every_ablation_changes_the_configuration_as_it_says():
    config = load_experiment("bc_ablation")
    found = {}
    for name, condition in config.conditions.items():
        words = shlex.split(condition.arguments.get("bc", "").format())
        found[name] = read_config("bc", None, parse_options(words[1::2]))
    assert found.pop("base") == BCConfig()
    assert found["larger_images"].image_sizes == {"workspace": 128, "wrist": 96}
    assert found["no_film"].film == 0
    assert all(changed != BCConfig() for changed in found.values())
    with pytest.raises(ConfigError, match="dept: unknown key.*did you mean 'depth'"):
        read_config("bc", None, {"dept": 2})


def test_packages_that_a_library_adds_to_the_path_do_not_change_the_environment(tmp_path, monkeypatch):
    before = packages_sha256()
    added = tmp_path / "carried-1.0.dist-info"
    added.mkdir()
    (added / "METADATA").write_text("Metadata-Version: 2.1\nName: carried\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    packages_sha256.cache_clear()
    assert "carried" in {d.metadata["Name"] for d in metadata.distributions()}
    assert packages_sha256() == before


def test_a_card_names_processor_and_gpus(tmp_path):
    (tmp_path / "cpuinfo").write_text(
        "processor\t: 0\nmodel name\t: AMD EPYC 9654\nprocessor\t: 1\nmodel name\t: AMD EPYC 9654\n"
    )
    assert device(tmp_path) == "AMD EPYC 9654"
    gpu = tmp_path / "driver/nvidia/gpus/0000:01:00.0"
    gpu.mkdir(parents=True)
    (gpu / "information").write_text("Model: \t\t NVIDIA H100 80GB HBM3\nIRQ:   \t\t 16\n")
    assert device(tmp_path) == "AMD EPYC 9654, NVIDIA H100 80GB HBM3"
    assert device(tmp_path / "nothing") == platform.machine()
