"""JSON output is strict for all numbers."""

import json
import math

from ssplat_jax.storage.files import json_text, write_json


def refuse(name: str):
    raise AssertionError(f"{name} is not JSON")


def test_numbers_that_are_not_finite_are_null_at_any_depth():
    value = {"psnr": math.nan, "rows": [{"x": math.inf}, (1.5, -math.inf)], "name": "NaN", "n": 3}
    read = json.loads(json_text(value), parse_constant=refuse)
    assert read == {"psnr": None, "rows": [{"x": None}, [1.5, None]], "name": "NaN", "n": 3}


def test_json_without_indent_is_one_line():
    assert json_text({"a": [1, 2], "b": "x\ny"}, indent=None) == '{"a": [1, 2], "b": "x\\ny"}'


def test_a_file_ends_in_a_newline_and_reads_back(tmp_path):
    write_json(tmp_path / "a" / "table.json", [{"psnr": 20.5}])
    text = (tmp_path / "a" / "table.json").read_text()
    assert text.endswith("\n") and json.loads(text) == [{"psnr": 20.5}]
