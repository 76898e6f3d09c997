"""A file counts by what it holds; what is no lens says so in one line."""

import codecs
import gzip
import io
import zipfile

import pytest

from dolens import InputError, load_lens
from dolens.prescriptions.files import load_prescription
from tests.prescriptions.codev_samples import TRIPLET
from tests.prescriptions.samples import require_refused
from tests.prescriptions.test_oslo import TRIPLET as OSLO_TRIPLET
from tests.prescriptions.zemax_samples import triplet


def archive():
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as file:
        file.writestr("lens.zmx", triplet())
    return data.getvalue()


UNKNOWN = {
    "nothing": (b"", "is empty"),
    "blanks": (b" \r\n\t\n", "is empty"),
    "zip": (archive(), "is a .zip archive; unpack it"),
    "gzip": (gzip.compress(triplet().encode()), "is compressed (gzip); unpack it"),
    "zar": (b"\xec\x03\0\0\0\0\0\0" + bytes(300), "is an archive of OpticStudio (.zar); unpack it"),
    "zos": (b"ZoS\0\x01\0\0", "is OpticStudio's binary form of a lens (.zos)"),
    "pdf": (b"%PDF-1.7\n", "is a PDF document"),
    "html": (b"<!DOCTYPE html><title>404</title>", "is a page of a website (HTML)"),
    "utf-32": (codecs.BOM_UTF32_LE + triplet().encode("utf-32-le"), "is text in UTF-32"),
    "code v": (b"]\0\0\0Y\0\0\0" + b"New lens".ljust(300), "is CODE V's binary form of a lens"),
    "binary": (bytes(range(256)) * 9, "is binary, no text of a lens"),
    "prose": (b"Dear reader,\nthis is no lens.\n", "is no lens file that is known here"),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_what_is_no_lens_is_named_in_one_line(name, tmp_path):
    data, said = UNKNOWN[name]
    require_refused(tmp_path / "lens.dat", data, said)


@pytest.mark.parametrize("suffix", [".zmx", ".seq", ".len", ".json", ".yaml", ".txt"])
@pytest.mark.parametrize("name", [n for n in UNKNOWN if n != "prose"])
def test_the_suffix_does_not_hide_what_it_is(name, suffix, tmp_path):
    data, said = UNKNOWN[name]
    path = tmp_path / f"lens{suffix}"
    path.write_bytes(data)
    with pytest.raises(InputError, match=said.split("(")[0]):
        load_prescription(path)


def test_a_file_is_too_large_to_be_a_lens(tmp_path):
    path = tmp_path / "lens.zmx"
    with path.open("wb") as file:
        file.truncate(2**30)
    with pytest.raises(InputError, match="is larger than 64 MB, and no lens"):
        load_lens(path)


@pytest.mark.parametrize(
    ("text", "name"),
    [(triplet(), "Zemax"), (TRIPLET, "CODE V"), (OSLO_TRIPLET, "OSLO")],
    ids=["Zemax", "CODE V", "OSLO"],
)
@pytest.mark.parametrize("suffix", [".txt", ".lens", ".zmx"])
def test_content_counts_before_the_name(text, name, suffix, tmp_path):
    path = tmp_path / f"lens{suffix}"
    path.write_text(text)
    assert len(load_prescription(path)["surfaces"]) == 6


BOMB = "a: &a [1, 1]\n" + "".join(
    f"{n}: &{n} [*{m}, *{m}, *{m}, *{m}, *{m}, *{m}, *{m}, *{m}, *{m}]\n"
    for m, n in zip("abcdefghijk", "bcdefghijkl", strict=True)
)  # fmt: skip


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (BOMB, "it means more than 2000000 values"),
        ("a: &a [*a]\n", "it means more than 2000000 values"),
        ("[" * 20_000, "it is nested too deeply"),
        (f"a: {'9' * 10_000}", "is not valid YAML"),
    ],
    ids=["billions", "itself", "deep", "digits"],
)
def test_hostile_yaml_ends_in_one_line(text, said, tmp_path):
    path = tmp_path / "lens.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=said) as error:
        load_lens(path)
    assert "\n" not in str(error.value)
