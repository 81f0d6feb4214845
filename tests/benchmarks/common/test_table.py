import json

import numpy as np
import pandas as pd

from benchmarks.common.parts import Parts
from benchmarks.common.table import Table


def jobs(seeds):
    return [{"share": 3 * 2.65, "seed": seed} for seed in range(seeds)]


def test_what_the_file_holds_is_not_missing(tmp_path):
    table = Table(tmp_path / "new" / "halves.csv")
    first, second = jobs(2)
    assert table.missing(jobs(2)) == [first, second]
    table.append([first | {"value": 1 / 3}, first | {"value": 2.0}])
    assert table.missing(jobs(2)) == [second]
    table.append([second | {"value": 4}])
    assert table.missing(jobs(2)) == []
    assert table.missing(jobs(3)) == [jobs(3)[2]]
    assert table.path.read_text().split() == [
        "share,seed,value",
        "7.95,0,0.3333333",
        "7.95,0,2",
        "7.95,1,4",
    ]


def test_of_rows_with_the_same_key_the_last_counts(tmp_path):
    table = Table(tmp_path / "runs.csv", ("name", "setting"))
    table.append([{"name": "a", "setting": "", "value": np.nan}])
    table.append([{"name": "b", "setting": "", "value": 2}])
    assert table.read().value.isna().tolist() == [True, False]
    table.append([{"name": "a", "setting": "", "value": 3}])
    frame = table.read()
    assert frame.to_dict("list") == {"name": ["b", "a"], "setting": ["", ""], "value": [2, 3]}


def test_columns_are_those_of_the_file_then_those_named(tmp_path):
    table = Table(tmp_path / "runs.csv", columns=("a", "b"))
    assert list(table.read()) == ["a", "b"]
    table.append([{"b": 1, "a": 2, "c": 3}])
    Table(table.path, columns=("c", "b")).append([{"c": 4, "b": 5}])
    assert table.path.read_text() == "a,b\n2,1\n,5\n"


def test_nothing_to_append_makes_no_file(tmp_path):
    Table(tmp_path / "runs.csv").append([])
    assert not (tmp_path / "runs.csv").exists()


def test_rows_are_replaced_where_columns_agree(tmp_path):
    table = Table(tmp_path / "runs.csv")
    table.append([{"part": part, "value": value} for part, value in [("a", 1), ("b", 2), ("a", 3)]])
    table.replace([{"part": "a", "value": 4.5}], part="a")
    pd.testing.assert_frame_equal(
        table.read(), pd.DataFrame({"part": ["b", "a"], "value": [2.0, 4.5]})
    )


def test_parts_hold_nested_values_of_seven_digits(tmp_path):
    parts = Parts(tmp_path / "speed.csv")
    assert parts.read() == {}
    parts.replace("one", [{"a": {"b": [1 / 3, "x, y", None]}}, {"c": float("inf")}])
    parts.replace("two", [{"d": True}])
    parts.replace("one", [{"a": {"b": [2 / 3]}}])
    assert parts.read() == {"two": [{"d": True}], "one": [{"a": {"b": [0.6666667]}}]}
    assert len(parts.path.read_text().splitlines()) == 3
    assert json.loads(json.dumps(parts.read())) == parts.read()
