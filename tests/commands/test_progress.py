"""What a person reads while work goes on."""

from d2_plugin import progress


def test_the_time_left_is_that_of_the_work_not_of_what_began_it(monkeypatch, capsys) -> None:
    """Workers that take 40 s to start, then a unit a second: 65 s are left for 65 units, not five minutes."""
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    monkeypatch.setattr(progress, "_silent", False)
    with progress.progress_bar("between", 76) as bar:
        for done in range(1, 77):
            now = 39.0 + done
            bar.update(done)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["between: 1/76 ", "between: 11/76, 65 s left "]
    assert lines[-1] == "between: 76/76, 0 s left "
