"""Every answer of a policy is a chunk of actions or `invalid_action`; no other exception, no silent cast."""

from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.actions import ActionSemantics, check_chunk
from roboxim_core.errors import ErrorCode, InvalidRequestError, PolicyError, printable
from roboxim_core.policies import ActionChunk, CameraRequirement, EpisodeStart, Observation, PolicyDescription
from roboxim_core.policies import ObservationWindow as Window
from roboxim_core.policy_guard import GuardedPolicy, checked_answer

GOOD = [0.01, 0, 0, 0, 0, 0, 1.0]
HORIZON = 4
DESCRIPTION = PolicyDescription(name="p", horizon=HORIZON)


class Raising:
    """An object that raises an exception on every access, like a tensor that requires a gradient."""

    def __init__(self, error):
        self.error = error

    def __array__(self, dtype=None, copy=None):
        raise self.error

    def __repr__(self):
        raise self.error


class NoLength(list):
    """A list whose length cannot be read."""

    def __len__(self):
        raise RuntimeError("no length")


class NoWords(RuntimeError):
    """An exception whose text cannot be read."""

    def __str__(self):
        raise RuntimeError("no words either")


def recursive():
    endless = []
    endless.append(endless)
    return endless


BAD_ACTIONS = {
    "none": None,
    "string": "up",
    "strings": ["0.1"] * 7,
    "bytes": b"1234567",
    "bytes in a row": [b"1"] * 7,
    "dict": {"actions": GOOD},
    "set": {1.0, 2.0},
    "generator": (x for x in GOOD),
    "function": len,
    "type": np.ndarray,
    "number": 1.0,
    "numbers without rows": np.float32(1.0),
    "boolean": True,
    "booleans": [True] * 7,
    "boolean array": np.ones(7, bool),
    "a boolean among floats": [0.01, 0, 0, 0, 0, 0, True],
    "a NumPy boolean among floats": [0.01, 0, 0, 0, 0, 0, np.True_],
    "boolean rows": [[0.0] * 6 + [False]] * 2,
    "complex": np.zeros(7, complex),
    "a complex among floats": [0j, 0, 0, 0, 0, 0, 1],
    "a none among floats": [None, 0, 0, 0, 0, 0, 1],
    "huge integer": [10**400, 0, 0, 0, 0, 0, 1],
    "huge integers": [[10**400] * 7],
    "integer beyond 64 bits": [10**30, 0, 0, 0, 0, 0, 1],
    "masked array": np.ma.array(GOOD, mask=[1, 0, 0, 0, 0, 0, 0]),
    "masked array without masked values": np.ma.array(GOOD),
    "masked rows": [np.ma.array(GOOD, mask=[1, 0, 0, 0, 0, 0, 0])],
    "masked number in a row": [np.ma.masked, 0, 0, 0, 0, 0, 1],
    "objects": np.array(GOOD, object),
    "dates": np.zeros(7, "datetime64[s]"),
    "durations": np.zeros(7, "timedelta64[s]"),
    "structured": np.zeros(7, [("a", "f4")]),
    "NaN": [np.nan, 0, 0, 0, 0, 0, 1],
    "infinity": [np.inf, 0, 0, 0, 0, 0, 1],
    "minus infinity": np.array([GOOD, [-np.inf] * 7]),
    "too large for float32": [1e39, 0, 0, 0, 0, 0, 1],
    "too large for float32, as an array": np.full(7, -1e300),
    "long double": np.full(7, np.finfo(np.longdouble).max),
    "six numbers": np.zeros(6),
    "eight numbers": np.zeros((1, 8)),
    "transposed": np.zeros((7, 2)),
    "no rows": np.zeros((0, 7)),
    "no numbers": [],
    "rows without numbers": [[], []],
    "three dimensions": np.zeros((1, 1, 7)),
    "nested lists": [[[0.0] * 7]],
    "ragged": [[0.0] * 7, [0.0] * 6],
    "ragged deeper": [0.0, [0.0] * 6],
    "five rows": np.zeros((HORIZON + 1, 7)),
    "five rows in a list": [GOOD] * (HORIZON + 1),
    "huge horizon": np.broadcast_to(np.zeros(7), (10**12, 7)),
    "huge horizon in a list": [GOOD] * 100_000,
    "huge row": [0.0] * 100_000,
    "endless list": recursive(),
    "requires a gradient": Raising(RuntimeError("Can't call numpy() on Tensor that requires grad")),
    "on a GPU": Raising(TypeError("can't convert cuda:0 device type tensor to numpy")),
    "raises SystemExit": Raising(SystemExit(1)),
    "raises MemoryError": Raising(MemoryError()),
    "raises without words": Raising(NoWords()),
    "raises in a row": [Raising(RuntimeError("no"))] * 7,
    "a list without length": NoLength(GOOD),
    "a policy's answer within an answer": [ActionChunk(actions=np.zeros((1, 7)))],
}
BAD_REST = {
    "phases none": {"phases": None},
    "phases a string": {"phases": "free"},
    "phases a number": {"phases": 3},
    "phases of another length": {"phases": ("free", "free")},
    "phases of numbers": {"phases": (1,)},
    "phases of bytes": {"phases": (b"free",)},
    "phases of none": {"phases": (None,)},
    "phases a dict": {"phases": {"free": 1}},
    "a phase without end": {"phases": ("free" * 1000,)},
    "a phase that is no text": {"phases": ("\ud800",)},
    "a phase with a zero": {"phases": ("free\0",)},
    "phases that raise": {"phases": Raising(RuntimeError("no"))},
    "done none": {"done": None},
    "done a number": {"done": 1},
    "done a string": {"done": "yes"},
    "done an array": {"done": np.array([True])},
    "done that raises": {"done": Raising(RuntimeError("no"))},
}
ANSWERS = BAD_ACTIONS | {
    f"chunk, {name}": ActionChunk(**({"actions": np.zeros((1, 7), np.float32)} | rest))
    for name, rest in BAD_REST.items()
}
ANSWERS |= {f"chunk of {name}": ActionChunk(actions=BAD_ACTIONS[name]) for name in ("none", "masked array", "ragged")}


class Answers:
    def __init__(self, answer, description=DESCRIPTION):
        self.answer, self.description = answer, description

    def describe(self):
        return self.description

    def reset(self, start):
        pass

    def act(self, window):
        return self.answer


def asked(answer, description=DESCRIPTION):
    guard = GuardedPolicy(Answers(answer, description))
    guard.reset(EpisodeStart(episode_id="e", instruction="", seed=0))
    window = Window(
        instruction="", observations=[Observation(seq=0, stamp_ns=0)], pad_mask=(True,), episode_id="e", seq=0
    )
    return guard.act(window)


@pytest.mark.parametrize("name", ANSWERS)
def test_it_is_an_invalid_action(name):
    with pytest.raises(PolicyError) as caught:
        asked(ANSWERS[name])
    assert caught.value.code == ErrorCode.INVALID_ACTION
    message = str(caught.value)
    assert message.startswith("policy 'p' in act at tick 0 of episode e: ")
    assert len(message) < 3000
    message.encode()  # a service can carry it


def test_arrays_of_other_libraries_are_actions_or_refused():
    jnp = pytest.importorskip("jax.numpy")
    assert asked(jnp.asarray(GOOD)).actions.tolist() == np.float32([GOOD]).tolist()
    for bad in (jnp.ones(7, bool), jnp.ones(7, jnp.bfloat16), jnp.ones(7, complex), [jnp.asarray(True)] * 7):
        with pytest.raises(PolicyError) as caught:
            asked(bad)
        assert caught.value.code == ErrorCode.INVALID_ACTION


@pytest.mark.parametrize(
    "good",
    [
        GOOD, tuple(GOOD), [GOOD], [GOOD, GOOD], np.array(GOOD), np.array([GOOD], np.float16), np.array(GOOD, ">f8"),
        np.zeros(7, np.int64), [np.float32(0)] * 7, [np.array(GOOD)] * 4, np.asfortranarray([GOOD] * 3), [0] * 7,
        np.array([GOOD] * 8)[::2], np.matrix(GOOD),
    ],
)  # fmt: skip
def test_numbers_of_any_kind_are_actions(good):
    chunk = asked(good)
    assert chunk.actions.dtype == np.float32
    np.testing.assert_allclose(chunk.actions, np.atleast_2d(np.asarray(good, np.float32)))
    assert (chunk.done, chunk.phases) == (False, ())


def test_what_else_a_chunk_says_is_passed_on():
    chunk = asked(ActionChunk(actions=[GOOD, GOOD], done=np.True_, phases=["free", "grasp"]))
    assert chunk.done is True
    assert chunk.phases == ("free", "grasp")


def test_the_size_of_an_action_is_that_of_its_semantics():
    quaternion = replace(DESCRIPTION, semantics=ActionSemantics(rotation="quaternion_xyzw"))
    assert checked_answer([0.0] * 8, quaternion).actions.shape == (1, 8)
    with pytest.raises(PolicyError, match=r"shape \(horizon, 8\), got \(7,\)"):
        checked_answer(GOOD, quaternion)
    joint = replace(DESCRIPTION, semantics=ActionSemantics(control="joint_position"))
    assert checked_answer(np.zeros((2, 8)), joint).actions.shape == (2, 8)


def test_messages_name_the_place():
    with pytest.raises(InvalidRequestError, match="got nan at step 1, component 2"):
        check_chunk([GOOD, [0, 0, np.nan, 0, 0, 0, 1]])
    with pytest.raises(InvalidRequestError, match=r"got 1e\+39 at step 0, component 0"):
        check_chunk([1e39, 0, 0, 0, 0, 0, 1])
    with pytest.raises(InvalidRequestError, match="a list with a bool"):
        check_chunk([True] * 7)
    with pytest.raises(InvalidRequestError, match="masked array; fill"):
        check_chunk(np.ma.array(GOOD))


class Odd(BaseException):
    """A `BaseException` that is neither an `Exception` nor Ctrl-C."""


@pytest.mark.parametrize("error", [Odd("x"), GeneratorExit(), NoWords(), RuntimeError("\ud800\0" + "x" * 10_000)])
def test_whatever_a_policy_raises_is_its_fault_in_words_that_a_service_can_carry(error):
    policy = Answers(None)
    policy.act = lambda window: (_ for _ in ()).throw(error) if False else raise_(error)
    logged = []
    guard = GuardedPolicy(policy, log=logged.append)
    guard.reset(EpisodeStart(episode_id="e", instruction="", seed=0))
    window = Window(
        instruction="", observations=[Observation(seq=0, stamp_ns=0)], pad_mask=(True,), episode_id="e", seq=0
    )
    with pytest.raises(PolicyError) as caught:
        guard.act(window)
    assert caught.value.code == ErrorCode.POLICY_FAULT
    for text in (str(caught.value), *logged):
        assert "\0" not in text
        text.encode()
    assert len(str(caught.value)) < 3000


def raise_(error):
    raise error


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"name": 3}, "name must be a printable string"),
        ({"name": "x" * 2000}, "name must be a printable string"),
        ({"version": None}, "version must be a printable string"),
        ({"window": True}, "window must be a whole number from 1"),
        ({"window": 0}, "window must be a whole number from 1"),
        ({"window": 10**9}, "window must be a whole number from 1"),
        ({"horizon": 2.0}, "horizon must be a whole number"),
        ({"horizon": 10**400}, "horizon must be a whole number"),
        ({"privileged": "no"}, "privileged must be a bool"),
        ({"semantics": "end_effector_delta"}, "semantics must be a ActionSemantics"),
        ({"cameras": "wrist"}, "cameras must be a tuple"),
        ({"cameras": ("wrist",)}, "a camera must be a CameraRequirement"),
    ],
)
def test_a_description_that_is_none_is_refused_by_field(change, word):
    with pytest.raises(InvalidRequestError, match=word):
        PolicyDescription(**({"name": "p"} | change))


def test_a_camera_of_no_size_is_refused():
    for change in ({"width": -1}, {"height": 10**9}, {"width": 32.0}, {"name": None}):
        with pytest.raises(InvalidRequestError, match="camera"):
            CameraRequirement(**({"name": "wrist"} | change))


def test_any_text_becomes_printable():
    assert printable("a") == "a"
    assert printable(NoWords()) == "(a NoWords that cannot be shown)"
    assert len(printable("x" * 5000, 10)) == 13
