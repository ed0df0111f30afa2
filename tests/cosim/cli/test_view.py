import json

import pytest

from tests.helpers.drawing import skip_without_driver


@pytest.fixture
def recording(cosim):
    assert cosim("simulate", "--steps", 20, "--out", "run", "--record")[0] == 0
    return "run/run.rrd"


def test_json_tells_properties_and_ranges(cosim, recording, paper):
    code, out, _ = cosim("view", recording, "--json")
    content = json.loads(out)
    assert code == 0
    assert content["properties"]["scenario_hash"] == paper.hash
    assert content["signals"]["P2"]["unit"] == "kPa"


@pytest.mark.slow
def test_png_draws_the_recording(cosim, recording, tmp_path):
    code, _, err = cosim("view", recording, "--png", "run.png", "--at", 600)
    skip_without_driver(err)
    assert code == 0
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
