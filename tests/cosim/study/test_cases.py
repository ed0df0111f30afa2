from pathlib import Path

from cosim.study.cases import expand
from cosim.study.document import CaseTable, SeedsTable
from tests.helpers.toy_trainer import ToyTrainer


def cases(**table):
    given = {"name": "c", "algorithm": "grow"} | table
    return expand(
        [CaseTable(**given)], ("paper",), SeedsTable(count=2), Path("/study"), ToyTrainer()
    )


def test_lists_are_a_grid_and_name_what_varies():
    found = cases(settings={"rate": [1, 2], "cap": 3}, start=["naive", "tuned"])
    assert [case.name for case in found] == [
        "c(start=naive rate=1)",
        "c(start=naive rate=2)",
        "c(start=tuned rate=1)",
        "c(start=tuned rate=2)",
    ]
    assert found[3].settings == {"rate": 2, "cap": 3}


def test_a_setting_that_is_a_list_itself_takes_a_list_of_lists_as_a_grid():
    assert [case.settings["weights"] for case in cases(settings={"weights": [1, 2]})] == [[1, 2]]
    found = cases(settings={"weights": [[1, 2], [3]]})
    assert [case.settings["weights"] for case in found] == [[1, 2], [3]]


def test_files_are_seen_from_the_study():
    assert cases(start="mine.toml")[0].start == str(Path("/study/mine.toml"))
    table = {"name": None, "algorithm": None, "controller": "theta/mine.toml"}
    case = cases(**table)[0]
    assert (case.name, case.controller) == ("mine", str(Path("/study/theta/mine.toml")))


def test_controllers_have_their_own_names_and_no_training_seeds():
    found = cases(name=None, algorithm=None, controller=["naive", "mine.module:make"])
    assert [case.name for case in found] == ["naive", "mine.module.make"]
    assert not any(case.training_seeds for case in found)
