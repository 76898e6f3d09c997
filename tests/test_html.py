"""Templates escape whatever text they are given, and every name they use must be given."""

import jinja2
import pytest

from dolens.html import rendered


def test_text_is_escaped_and_has_no_control_characters(tmp_path):
    template = tmp_path / "one.html"
    template.write_text('<p title="{{ said }}">{{ said }} {{ [said] | join }}</p>')
    said = '<"&\x1b\ud800'
    text = "&lt;&#34;&amp;��"
    assert rendered(template, said=said) == f'<p title="{text}">{text} {text}</p>'
    with pytest.raises(jinja2.UndefinedError, match="said"):
        rendered(template, said_otherwise=said)


def test_data_of_a_script_do_not_end_it(tmp_path):
    template = tmp_path / "one.html"
    template.write_text("<script>{{ data | tojson }}</script>")
    data = rendered(template, data={"b": ["</script>", 1.5], "a": 2})
    assert data == '<script>{"b":["\\u003c/script\\u003e",1.5],"a":2}</script>'
