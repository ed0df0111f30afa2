"""``python -m fmus.checks TOOL SUBJECT FILE``: one check; its JSON is the last line printed."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from fmus.checks import run

tool, subject, fmu = sys.argv[1:]
finding = run(tool, subject, Path(fmu))
print("\n" + json.dumps([finding.status, finding.detail]))
