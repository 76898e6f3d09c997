"""A file is written whole, or the one before it stays."""

import errno

import pytest

from dolens.files import written_whole


def test_what_was_written_takes_the_place_of_the_file(tmp_path):
    path = tmp_path / "lens.yaml"
    path.write_text("before")
    with written_whole(path) as aside:
        aside.write_text("after")
        assert path.read_text() == "before" and aside.parent == tmp_path
    assert [p.name for p in tmp_path.iterdir()] == ["lens.yaml"] and path.read_text() == "after"


@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_what_is_interrupted_leaves_the_file_before_it_and_nothing_else(tmp_path, fault):
    path = tmp_path / "lens.yaml"
    path.write_text("before")
    with pytest.raises(type(fault)), written_whole(path) as aside:
        aside.write_text("aft")
        raise fault
    assert [p.name for p in tmp_path.iterdir()] == ["lens.yaml"] and path.read_text() == "before"


def test_an_error_names_the_file_that_was_asked_for(tmp_path):
    path = tmp_path / "nowhere" / "lens.yaml"
    with pytest.raises(FileNotFoundError) as caught, written_whole(path) as aside:
        aside.write_text("after")
    assert caught.value.filename == str(path)


def test_a_disk_that_is_full_amid_writing_names_the_file_too(tmp_path):
    with pytest.raises(OSError) as caught, written_whole(tmp_path / "lens.yaml") as aside:
        aside.write_text("aft")
        raise OSError(errno.ENOSPC, "No space left on device")  # as `write` raises it
    assert caught.value.filename == str(tmp_path / "lens.yaml")
