import math
import re
from dataclasses import replace

import numpy as np
import pytest

from roboxim_eval.report.charts.course import Curve, course_chart
from roboxim_eval.report.course import ConditionCourse, shown, what_happened
from roboxim_eval.report.episode import EpisodePage, OtherWay, Signals, cause_of, episode_page, episode_text, sparkline
from roboxim_eval.report.films import film_strip


def condition(name, measure, values, least=-math.inf, most=math.inf, **more):
    values = np.array(values, float)
    return ConditionCourse(
        name=name,
        measure=measure,
        values=values,
        least=least,
        most=most,
        holds=(values >= least) & (values <= most),
        **more,
    )


def picking(lift, fingers):
    return [
        condition("not_fallen", "lift_m", lift, least=-0.1, reason="fell_off_table", fatal=True),
        condition("grasped", "pressing_links", fingers, least=2.0),
        condition("lifted", "lift_m", lift, least=0.05),
        condition("off_table", "table_force_n", [float(x <= 0) for x in lift], most=0.0, reason="touches_table"),
    ]


def test_a_sentence_says_how_far_it_came_and_when_it_was_lost():
    lift = [0.0] * 40 + [0.01, 0.02, 0.031, 0.02, 0.0] + [0.0] * 5
    fingers = [0.0] * 38 + [2.0] * 5 + [1.0] + [0.0] * 6
    said = what_happened(picking(lift, fingers), solved=False, reason="not_grasped")
    assert said == "Lifted 3.1 cm of 5 at tick 42, then slipped at tick 43 (fingers pressing it 1 of 2)."
    never = what_happened(picking([0.0] * 9, [0.0] * 9), solved=False, reason="not_grasped")
    assert never == "0 of 2 fingers pressed it, lifted 0 cm of 5."
    fell = what_happened(picking([0.0, -0.05, -0.3, -0.3], [0.0] * 4), solved=False, reason="fell_off_table")
    assert fell == "The object fell off the table at tick 2 (lift -30 cm, allowed -10 cm)."
    held = [condition("inside", "distance_m", [0.0, 0.0], most=0.01)]
    assert what_happened(held, solved=False, reason="not_held", hold_s=0.5, held_s=0.2) == (
        "All conditions held, but for 0.2 s of 0.5 s."
    )
    pushed = [
        condition("pushed", "along_m", [0.0, 0.01, 0.02], least=0.05),
        condition("reference_stayed", "reference_shift_m", [0.0, 0.0, 0.04], most=0.03, reason="moved_reference"),
        condition("straight", "lateral_ratio", [0.0, 1.0, 1.0], most=0.7),
    ]
    assert what_happened(pushed, solved=False, reason="not_pushed") == (
        "Moved 2 cm of 5 along the direction at tick 2, then the object that the instruction refers to was moved at "
        "tick 2 (reference shift 4 cm, allowed 3 cm)."
    )
    tilted = [condition("upright", "tilt_rad", [1.57, 1.4, 1.5], most=0.17)]
    assert what_happened(tilted, solved=False, reason="not_upright") == "Tilt was never below 80.2°, allowed 9.7°."
    placed = [condition("on_support", "support_force_n", [0.0, 0.0], least=math.nextafter(0.0, 1.0))]
    assert what_happened(placed, solved=False, reason="not_on_support") == ("Nothing rested on its support.")
    assert what_happened(picking(lift, fingers), solved=True, reason="") == ""
    assert what_happened([], solved=False, reason="x") == ""


@pytest.mark.parametrize(
    ("measure", "value", "text"),
    [("lift_m", 0.031, "3.1 cm"), ("tilt_rad", math.pi / 2, "90°"), ("speed_m_s", 0.1, "10 cm/s"),
     ("table_force_n", 1.23, "1.2 N"), ("pressing_links", 2.0, "2"), ("drawer_speed_m_s", -0.004, "-0.4 cm/s")],
)  # fmt: skip
def test_measures_are_shown_in_units_that_people_read(measure, value, text):
    assert shown(measure, value) == text


def page_of(**changes):
    film = film_strip([np.full((16, 32, 3), 10 * i, np.uint8) for i in range(20)], max_frames=None, frame_ms=100.0)
    lift = [0.0] * 10 + [0.02, 0.03] + [0.0] * 8
    fingers = [0.0] * 9 + [2.0] * 3 + [0.0] * 8
    action = Curve(name="<dx>", lines=(np.array([np.nan, *np.linspace(0, 1, 19)]),))
    return replace(EpisodePage(
        episode_id="eval-0-00007-0", actor="bc", instruction="Pick up <the cube>", outcome="failure",
        reason="not_grasped", explanation="Slipped.", message="", steps=15, ticks=20, tick_s=0.1,
        conditions=picking(lift, fingers), signals=[Signals(name="Action", curves=[action])],
        held=[{"object": "cube", "role": "target"}], facts={"robot": "panda"}, commands="roboxim replay BAG", film=film,
        others=[OtherWay(name="expert", outcome="success", text="12 actions.", film=film)], log="hello",
    ), **changes)  # fmt: skip


def test_an_episodes_page_marks_what_decided_and_is_one_file():
    page = episode_page(page_of())
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert "<the cube>" not in page
    assert "<dx>" not in page
    decided = re.findall(r'class="card condition cause"><p><b>\S+ (\w+)', page)
    assert decided == ["grasped"], "the first condition that is broken, alone"
    assert "lost at tick 12" in page
    assert 'data-tick="12"' in page
    assert page.count('data-frames="20"') == 2, "all frames, of the expert as well"
    assert 'data-ms="100.0"' in page, "at the episode's rate"
    assert page.index("<h2>What it was judged by") < page.index("Held throughout") < page.index("hello")
    without = episode_page(
        page_of(film=None, others=[], nobody="Nobody else acted.", conditions=(), log="", log_note="no")
    )
    assert "This episode has no cameras." in without
    assert "Nobody else acted." in without


def test_the_text_of_an_episode_says_the_same_in_a_terminal():
    text = episode_text(page_of())
    assert text.splitlines()[0] == "Pick up <the cube>: failure (not_grasped)"
    assert re.search(r"^> grasped +fingers pressing it at least 2 +lost at tick 12", text, re.MULTILINE)
    assert "held throughout: not_fallen" in text
    assert "expert: success. 12 actions." in text
    assert "\n  hello\n" in text
    assert cause_of(page_of().conditions, "not_lifted").name == "lifted"
    assert sparkline([0, 0, 1, 1], width=2) == "▁█"
    assert sparkline([3.0, 3.0]) == "▁▁"
    assert sparkline([math.nan]) == ""


def test_a_chart_shades_where_a_condition_does_not_hold():
    values = np.array([0.0, 1.0, 2.0, 1.0, 0.0])
    curve = Curve(name="lift", lines=(values,), limits=(1.5, math.inf), broken=values < 1.5, mark=3)
    picture = str(course_chart(curve))
    shaded = re.findall(r'<rect x="(\d+)" y="0" width="(\d+)"', picture)
    assert shaded == [("0", "2"), ("3", "2")]
    assert picture.count('class="limit"') == 1
    assert picture.count('class="mark-at"') == 1
    assert "<span class=" in picture
    assert "/>" not in re.findall(r"<(?:span|output)[^>]*>", picture), "HTML has no empty span"
    gap = str(course_chart(Curve(name="dx", lines=(np.array([np.nan, 1.0, 2.0, np.nan, 3.0, 1.0]),))))
    assert gap.count("<polyline") == 2
