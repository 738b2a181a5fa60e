"""The evaluator's clients."""

from __future__ import annotations

import pytest
from roboxim_interfaces.srv import LoadScene
from simulation_interfaces.srv import GetSimulatorFeatures

from roboxim_core.episode import EpisodeStep
from roboxim_core.errors import ErrorCode, EvaluationError, RecorderError
from roboxim_core.specs import SceneSpec
from roboxim_core.verdicts import Verdict
from roboxim_eval.ports import RecorderClient, SimClient


class _Refusing:
    """Clients of a recorder that refuses each step."""

    class node:
        create_subscription = create_publisher = staticmethod(lambda *_: None)

    def send_local(self, *_):
        return object()

    def value_of(self, *_):
        raise RecorderError("the disk is full", ErrorCode.DISK)


def test_a_step_that_the_recorder_refused_is_not_waited_for():
    """Its acknowledgement never comes: the run would end a minute later."""
    recorder = RecorderClient(_Refusing(), "/out")
    step = EpisodeStep(
        episode_id="e", seq=0, stamp_ns=0, phase="act", action_label=(), action_executed=(), disturbance=False,
        verdict=Verdict(), inference_s=0.0,
    )  # fmt: skip
    with pytest.raises(RecorderError, match="full"):
        recorder.step(step)
    assert recorder._sent is None
    recorder.wait_written()


class _Sim:
    """Clients of a sim whose default renderer changes between two requests."""

    class node:
        resolve_topic_name = staticmethod(str)

    def call(self, kind, *_, **__):
        if kind is LoadScene:
            return LoadScene.Response(renderer="tiny (CPU)")
        response = GetSimulatorFeatures.Response()
        response.features.custom_info = '{"renderer": "raster", "device": "GPU"}'
        return response


def test_an_episode_that_names_another_renderer_than_drew_it_is_refused():
    sim = SimClient(_Sim())
    assert sim.renderer == "raster (GPU)"
    with pytest.raises(EvaluationError, match=r"names the renderer raster \(GPU\).*draws with tiny"):
        sim.load("e", SceneSpec())
