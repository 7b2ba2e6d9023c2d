"""report.html: complete, self-contained and well-formed; looked at in a browser where there is one."""

import base64
import io
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from fake_diagnosis import pad_diagnosis, robot_diagnosis
from pad_sets import make_robot_set, make_set, write_set
from PIL import Image

from lerobot_vtrefine.cli.report.press_film import MOST_FRAMES, press_film
from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.recordings import read_recording_set
from lerobot_vtrefine.diagnose.report import render_report
from lerobot_vtrefine.diagnose.report.effects import effect_drawing
from lerobot_vtrefine.diagnose.report.figures import error_figure
from lerobot_vtrefine.diagnose.report.numbers import digits, interval, percent, quantity
from lerobot_vtrefine.diagnose.report.words import MAIN_PARAMETERS, meaning, ties
from lerobot_vtrefine.diagnose.verdict import CAUSES, DataIssue, Heldout, Unknown, Verdict
from lerobot_vtrefine.pages.charts import ticks
from lerobot_vtrefine.pages.pads import GAP_TAXELS
from lerobot_vtrefine.pages.rates import Bar, Series, bar_chart, line_chart
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.contact import KelvinVoigt
from lerobot_vtrefine.tactile.stages.readout import Gain

ISSUE = DataIssue("trial_0003.parquet", "starts loaded", "set aside")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
VOID = {"meta", "br", "img", "link", "input", "hr", "rect", "path", "circle", "polyline", "polygon"}


@pytest.fixture(scope="module")
def pad_set(tmp_path_factory):
    return read_recording_set(write_set(tmp_path_factory.mktemp("pad") / "presses", *make_set()))


@pytest.fixture(scope="module")
def robot_set(tmp_path_factory):
    return read_recording_set(write_set(tmp_path_factory.mktemp("robot") / "moves", *make_robot_set()))


INVALID = Diagnosis(Verdict("invalid_data", data_issues=(ISSUE,)))


def page(diagnosis, recordings, issues=(ISSUE,)):
    found = diagnosis.noting(*issues)
    return render_report(replace(found, checked=len(recordings.trials) - 1), recordings, 0)


def text_of(html):
    body = re.sub(r"<style>.*?</style>", "", html, flags=re.DOTALL)
    return " ".join(re.sub(r"<[^>]+>", " ", body).split())


class Balance(HTMLParser):
    """Collects open tags; every closing one must match the last."""

    def __init__(self):
        super().__init__()
        self.open, self.wrong = [], []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.wrong.append((tag, self.getpos()))


@pytest.mark.parametrize("kind", ["pad", "robot", "invalid"])
def test_page_is_well_formed_and_needs_no_network(kind, pad_set, robot_set):
    html = {
        "pad": lambda: page(pad_diagnosis(), pad_set),
        "robot": lambda: page(robot_diagnosis(), robot_set),
        "invalid": lambda: page(INVALID, pad_set, ()),
    }[kind]()
    balance = Balance()
    balance.feed(html)
    assert balance.wrong == []
    assert balance.open == []
    assert not re.findall(r"(?:https?:)?//[a-z]", html)
    assert not re.findall(r"<(?:link|script|iframe)\b", html)
    sources = re.findall(r'(?:src|href)="([^"]*)"', html)
    assert all(re.match("data:image/(png|gif);base64,", source) for source in sources)
    assert "nan" not in re.sub(r"base64,[^\"]*", "", html).lower()


def test_named_causes_are_drawn_and_the_page_says_what_to_do(pad_set):
    html = page(pad_diagnosis(), pad_set)
    assert html.count('<svg class="effect"') == 2
    assert "--env.sensor_model=sensor_model.json" in html
    nothing = page(pad_diagnosis(status="adequate", causes=()), pad_set)
    assert "What to do now" not in text_of(nothing)
    assert effect_drawing("no such cause") == ""


def test_a_press_in_motion_is_shown_beside_its_simulations(pad_set, robot_set):
    model = SensorModel((KelvinVoigt(), Gain(100.0)))
    # The models that users get may have seen the trial that is shown; these have not.
    diagnosis = replace(pad_diagnosis(), measured_models=(model, model))
    film = press_film(diagnosis, pad_set)
    with Image.open(io.BytesIO(base64.b64decode(film["source"].partition(",")[2]))) as gif:
        assert gif.size == (3 * pad_set.cols + 2 * GAP_TAXELS, pad_set.rows)
        assert 20 < gif.n_frames <= MOST_FRAMES
    assert press_film(robot_diagnosis(), robot_set) is None


def test_first_line_is_the_verdict_in_plain_words(pad_set, robot_set):
    explained = text_of(page(pad_diagnosis(), pad_set))
    assert explained.index("The simulation lacks taxel gain spread and hysteresis.") < 60
    assert "falls from 4.1 to 2.4 counts; 66 % of the squared error is removed" in explained
    assert "(95 % interval 61 % to 70 %). Noise alone is 2.3 counts." in explained

    ambiguous = text_of(page(robot_diagnosis(), robot_set))
    assert (
        "cannot tell whether it lacks backlash or control latency. It certainly lacks gravity sag."
        in ambiguous
    )
    adequate = pad_diagnosis(status="adequate", causes=())
    assert "The simulation is adequate" in text_of(page(adequate, pad_set))[:120]
    assert "No verdict is possible" in text_of(page(INVALID, pad_set, ()))[:120]


def test_first_line_says_which_names_held_out_recordings_do_not_confirm(pad_set):
    found = pad_diagnosis()
    assert "do not confirm" not in text_of(page(found, pad_set))
    first, second = found.verdict.causes
    doubted = replace(found.verdict, causes=(first, replace(second, heldout_gain=-0.04)))
    text = text_of(page(replace(found, verdict=doubted), pad_set))
    words = "Held-out recordings do not confirm hysteresis: without it they are predicted better."
    assert words in text[:600]


def test_a_model_that_is_not_handed_out_is_not_offered(pad_set):
    withheld = text_of(page(pad_diagnosis(withheld=True), pad_set))
    assert "The simulation lacks taxel gain spread and hysteresis." in withheld[:200]
    assert "are predicted worse, so sensor_model.json is the refitted baseline" in withheld
    assert "What to do now" not in withheld
    assert "of the squared error is removed" not in withheld


def test_a_gain_that_locked_recordings_cannot_show_is_told_with_its_interval(pad_set):
    found = pad_diagnosis()
    held = replace(found.verdict.heldout, baseline=2.4, extended=2.5, gain=-0.09, gain_ci95=(-0.3, 0.1))
    text = text_of(page(replace(found, verdict=replace(found.verdict, heldout=held)), pad_set))
    assert "goes from 2.4 to 2.5 counts (95 % interval \N{MINUS SIGN}30 % to 10 %)" in text
    assert "The interval of the gain includes zero" in text
    assert "falls from" not in text


def test_ties_are_told_once_whatever_their_order():
    groups = (("backlash", "joint_friction"), ("joint_friction", "backlash"), ("latency", "crosstalk"))
    verdict = Verdict("ambiguous", ambiguous_with=groups, next_experiment={"text": "drag it"})
    assert ties(verdict) == [
        "backlash or joint friction",
        "latency or crosstalk",
    ]


def test_nothing_wrong_is_said_without_an_extension(pad_set):
    text = text_of(page(pad_diagnosis(status="adequate", causes=()), pad_set))
    assert text.index("The simulation is adequate") < 60
    assert "Nothing was added to the model, so extended and simulated are the same" in text
    assert "More recordings would reveal smaller effects than those listed" in text
    assert "Nothing was added" not in text_of(page(pad_diagnosis(), pad_set))


def test_unknown_cause_demotes_names_to_symptoms(pad_set):
    symptoms = tuple(
        type(c)(c.name, "symptom", c.params, c.p_value, c.heldout_gain)
        for c in pad_diagnosis().verdict.causes
    )
    unknown = pad_diagnosis(
        status="unexplained", causes=symptoms, unknown=Unknown(True, "load × session time")
    )
    text = text_of(page(unknown, pad_set))
    assert "wrong in a way that no known cause explains. Clue: load × session time." in text[:240]
    assert "What may be wrong" in text
    assert "Vary one factor at a time" in text
    assert "a symptom: the real cause may be another" in text
    assert "Adding them to the model still removes 66 % of the squared error." in text[:400]
    held = replace(unknown.verdict.heldout, gain=0.1, gain_ci95=(-0.1, 0.3))
    unknown = replace(unknown, verdict=replace(unknown.verdict, heldout=held))
    assert "still removes" not in text_of(page(unknown, pad_set))


def test_residuals_say_what_they_are_drawn_against(pad_set, robot_set):
    text = text_of(page(pad_diagnosis(), pad_set))
    assert "Against history: how far the load is below the largest so far" in text
    assert "of the joint that the simulation misses most" not in text
    robot = robot_diagnosis()
    worst = robot.traces[0].channels[0]
    text = text_of(page(robot, robot_set))
    assert f"of the joint that the simulation misses most ({worst})" in text
    assert "into the pad" not in text


def test_headline_tells_the_first_of_several_clues(robot_set):
    clues = Unknown(True, f"left_waist: too few trials; {'; '.join(['right_elbow: too few trials'] * 9)}")
    text = text_of(page(robot_diagnosis(status="unexplained", causes=(), unknown=clues), robot_set))
    assert text.count("Clue: left_waist: too few trials.") == 1


def test_everything_found_and_not_found_is_there(pad_set):
    text = text_of(page(pad_diagnosis(), pad_set))
    for words in (
        "trial_0003.parquet starts loaded set aside",
        "crosstalk 0.4 0.99 0.1 % no more than chance gives",
        "Not found, ",
        "baseline drift baseline_drift – – – not identifiable here",
        "hysteresis width_m 0.21 mm 0.18 to 0.24 mm",
        "baseline k_n 380 N/m 371 to 390 N/m",
        "latency delay: 6 ms",
        "contact offset offset: 30 µm",
        "the worst predicted",
        "2 more held-out recordings",
        "Set aside: 1 of 8 recordings",
    ):
        assert words in text, words
    svg_titles = re.findall(r'aria-label="mean residual against (\w+)"', page(pad_diagnosis(), pad_set))
    assert svg_titles == ["load", "rate", "history", "position", "time"]


def test_next_experiment_is_a_protocol(robot_set):
    html = page(robot_diagnosis(), robot_set)
    assert "Move each joint to and fro at two speeds" in html
    assert "&#34;speeds_rad_s&#34;" in html


def test_text_from_files_is_escaped(pad_set):
    html = page(pad_diagnosis(), pad_set, [DataIssue("<script>alert(1)</script>.parquet", "a & b", "kept")])
    assert "<script" not in html
    assert "a &amp; b" in html


def test_sceptic_sees_weak_evidence(pad_set):
    base = pad_diagnosis().verdict
    weak = type(base.heldout)("rmse", 4.1, 4.0, 2.3, 0.05, (-0.02, 0.1), base.heldout.trials[:3])
    text = text_of(page(pad_diagnosis(heldout=weak), pad_set))
    assert "interval of the gain includes zero" in text
    assert "Only 3 held-out recordings:" in text
    assert "neither repaired nor noise" in text


def test_evidence_may_be_about_something_without_a_name(pad_set):
    nameless = replace(pad_diagnosis().evidence[0], name="(no name)")
    assert "(no name)" in text_of(page(pad_diagnosis(evidence=(nameless,)), pad_set))


def test_empty_findings_do_not_break_the_page(pad_set):
    bare = pad_diagnosis(
        status="adequate",
        causes=(),
        traces=(),
        residuals=(),
        trial_errors=(),
        maps={},
        evidence=(),
        heldout=None,
    )
    assert "The simulation is adequate" in page(bare, pad_set)


def test_every_cause_has_words():
    assert set(MAIN_PARAMETERS) == set(CAUSES)
    assert all(meaning(name) for name in CAUSES)


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        (quantity(0.0021, "m"), "2.1 mm"),
        (quantity(3e-5, "m"), "30 µm"),
        (quantity(0.05, "s"), "50 ms"),
        (quantity(1.5, "s"), "1.5 s"),
        (quantity(0.0, "m"), "0 mm"),
        (quantity(4e-4, "1/counts"), "0.0004 1/counts"),
        (digits(-0.5), "−0.5"),
        (percent(-1e-5), "0.0 %"),
        (percent(-0.0123), "−1.2 %"),
        (digits(12345.6), "12346"),
        (digits(2e-7), "2.00e-7"),
        (interval(0.05, (0.045, 0.056), "s"), ("50 ms", "45 to 56 ms")),
        (ticks(-0.3, 1.05, 4), [0.0, 0.5, 1.0]),
    ],
)
def test_numbers_read_well(shown, expected):
    assert shown == expected


@pytest.mark.parametrize("kind", ["pad", "robot"])
def test_screenshot(kind, pad_set, robot_set, tmp_path):
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        pytest.skip(f"no browser for a screenshot: none of {', '.join(BROWSERS)} is installed")
    html = page(pad_diagnosis(), pad_set) if kind == "pad" else page(robot_diagnosis(), robot_set)
    (tmp_path / "report.html").write_text(html, encoding="utf-8")
    picture = tmp_path / "report.png"
    command = [
        browser,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--hide-scrollbars",
        f"--screenshot={picture}",
    ]
    command += [f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1200,2400"]
    try:
        subprocess.run(
            [*command, (tmp_path / "report.html").as_uri()], capture_output=True, timeout=120, check=False
        )
    except subprocess.TimeoutExpired:
        pytest.skip("the browser did not start within two minutes")
    if not picture.is_file():
        pytest.skip("the browser does not run headless here")
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    assert pixels.shape == (2400, 1200, 3)
    background = pixels[5, 5]
    drawn = np.abs(pixels - background).sum(axis=2) > 40
    assert drawn[20:200].mean() > 0.02  # the verdict's text
    orange = (np.abs(pixels - [0xD9, 0x63, 0x2A]).sum(axis=2) < 60).sum(axis=1)
    assert orange[:600].sum() > 500  # the bar of the extended model
    assert orange[900:].sum() > 500  # its curves
    assert not drawn[:, :20].any()  # nothing runs out of the page on the left ...
    assert not drawn[:, -20:].any()  # ... or on the right


def test_charts_of_results_fit_a_phone() -> None:
    """A card leaves 288 of 360 pixels; a wider drawing is cut until somebody scrolls it."""
    rates = [Bar("imitation", 0.6, 0.5, 0.7), Bar("after DPPO", 0.9, 0.8, 1.0)]
    line = [Series("success", [(0, 0.1), (1, 0.2)])]
    drawings = [
        bar_chart(rates, "success"),
        line_chart(line, "iteration", "success"),
        error_figure(Heldout("rmse", 5.0, 1.0, 0.9, 0.95, (0.9, 0.97), ()), "counts"),
    ]
    widths = [int(re.search(r"min-width: (\d+)px", text)[1]) for text in drawings]
    assert max(widths) <= 288
