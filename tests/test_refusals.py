"""Commands that are typed wrongly are answered in one line."""

import re

from tests.refusals import answers


def test_commands_typed_wrongly_are_answered_in_one_line():
    for line, status, text in answers():
        if line == "pat":
            continue
        assert status == "2", line
        errors = [said for said in text.splitlines() if re.match("pat: (?!warning)", said)]
        assert len(errors) == 1, (line, text)
        assert "Traceback" not in text
        assert "expected no such" not in text
