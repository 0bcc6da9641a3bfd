import csv
import io
import json
from pathlib import Path

import pytest
from made_up import SESSION, plan, write_study, write_training
from PIL import Image

from pixel2catch.errors import StudyError
from pixel2catch.evaluation.comparison.plan import ComparisonFolder, Run
from pixel2catch.evaluation.comparison.report import (
    by_object_table,
    flat_csv,
    quality_table,
    rates_table,
    trainings_table,
    write_report,
)
from pixel2catch.evaluation.comparison.summary import object_rows, summary_rows, training_rows
from pixel2catch.evaluation.report import latex, markdown

TABLES = {f"table.{ending}" for ending in ("md", "tex", "csv", "json")} | {
    "by_object.md",
    "by_object.csv",
    "trainings.csv",
}
PICTURES = {"curves.png", "objects.png"}


@pytest.fixture
def study(tmp_path: Path) -> ComparisonFolder:
    return write_study(tmp_path)


def test_rates_stand_beside_the_paper(study: ComparisonFolder):
    row = rates_table(list(summary_rows(study, plan())))[2]
    assert row == {
        "method": "proposed",
        "objects": "seen",
        "seeds": "2",
        "T.R. [%]": "30.0 ± 14.1",
        "T.R., 95 % interval": "[24.1, 36.7]",
        "T.R., paper": "89.97 ± 0.21",
        "S.R. [%]": "30.0 ± 14.1",
        "S.R., 95 % interval": "[24.1, 36.7]",
        "S.R., paper": "84.13 ± 0.50",
    }


def test_dashes_for_one_seed_and_for_what_the_paper_does_not_have(study: ComparisonFolder):
    for name in ("proposed", "object_position"):
        source = study.evaluation(Run(method="proposed", seed=0), "seen").read_text()
        study.evaluation(Run(method=name, seed=0), "seen").write_text(source)
    (row,) = rates_table(list(summary_rows(study, plan(methods=("object_position",)))))
    assert row["S.R. [%]"] == "20.0 ± \N{EN DASH}"
    assert row["S.R., paper"] == "\N{EN DASH}"


def test_quality_has_units(study: ComparisonFolder):
    row = quality_table(list(summary_rows(study, plan())))[0]
    assert row["trials"] == "200"
    assert row["largest joint speed [rad/s]"] == "3.00"
    assert row["largest torque [% of limit]"] == "50.0"
    assert row["deepest penetration [mm]"] == "4.0"


def test_trainings_by_method(study: ComparisonFolder):
    """1 and 2 minutes: 1.5 with a sample deviation of 0.7."""
    rows = trainings_table(list(training_rows(study, plan())))
    assert [row["method"] for row in rows] == ["only_wh", "proposed"]
    assert rows[0]["wall-clock of a seed [min]"] == "1.5 ± 0.7"
    assert rows[0]["transitions of a seed"] == "300"


def test_objects_down_methods_across(study: ComparisonFolder):
    study.evaluation(Run(method="only_wh", seed=0), "unseen").unlink()
    study.evaluation(Run(method="only_wh", seed=1), "unseen").unlink()
    table = {row["object"]: row for row in by_object_table(list(object_rows(study, plan())))}
    assert table["cube_s"]["proposed"] == "60.0 [50.2, 69.1]"
    assert table["cross"]["only_wh"] == "\N{EN DASH}"


def test_markdown_lines_have_equal_columns(study: ComparisonFolder):
    lines = markdown(rates_table(list(summary_rows(study, plan())))).splitlines()
    assert len(lines) == 2 + 4
    assert len({line.count("|") for line in lines}) == 1


def test_latex_escapes_what_markdown_does_not():
    table = [{"method": "only_wh", "objects": "seen", "S.R. [%]": "8.0 ± 0.6"}]
    assert latex(table).splitlines() == [
        r"\begin{tabular}{llr}",
        r"\toprule",
        r"method & objects & S.R. [\%] \\",
        r"\midrule",
        r"only\_wh & seen & 8.0 $\pm$ 0.6 \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]
    marked = [{"setting": "**mean**", "first": r"90.0 [85, 93] \*"}]
    assert r"mean & 90.0 [85, 93] * \\" in latex(marked, num_text_columns=1)


def test_csv_has_all_numbers_unrounded(study: ComparisonFolder):
    rows = list(csv.DictReader(io.StringIO(flat_csv(list(summary_rows(study, plan()))))))
    assert float(rows[2]["success_rate_mean"]) == pytest.approx(0.3, abs=1e-12)
    assert float(rows[2]["success_rate_low"]) == pytest.approx(0.24074, abs=1e-5)
    assert rows[2]["paper_success_rate_mean"] == "0.8413"


def test_report_of_a_whole_study(study: ComparisonFolder):
    write_report(study)
    names = {path.name for path in study.report.iterdir()}
    assert names == TABLES | PICTURES | {"curves.csv", "README.md"}
    for name in PICTURES:
        with Image.open(study.report / name) as picture:
            assert picture.width >= 1000
            assert len(picture.convert("RGB").resize((64, 64)).getcolors(4096) or ()) > 20
    page = (study.report / "README.md").read_text()
    for words in (*PICTURES, SESSION["command"], "mujoco 4.0.0", "| training lr | 0.1 |", "stochastic"):
        assert words in page
    content = json.loads((study.report / "table.json").read_text())
    assert content["results"][2]["success_rate"]["values"] == [0.2, 0.4]


def test_report_of_a_study_that_has_just_begun(tmp_path: Path):
    folder = ComparisonFolder(tmp_path)
    folder.open(plan(), [SESSION])
    write_report(folder)
    names = {path.name for path in folder.report.iterdir()}
    assert names == TABLES | {"README.md"}
    assert "curves.png" not in (folder.report / "README.md").read_text()


def test_curves_before_the_first_evaluation(tmp_path: Path):
    folder = ComparisonFolder(tmp_path)
    folder.open(plan(), [SESSION])
    write_training(folder, Run(method="proposed", seed=1))
    write_report(folder)
    assert (folder.report / "curves.csv").read_text().splitlines()[1].startswith("proposed,1,50,")


def test_report_of_nothing(tmp_path: Path):
    with pytest.raises(StudyError, match=r"no study\.json"):
        write_report(ComparisonFolder(tmp_path))
    assert not list(tmp_path.iterdir())
