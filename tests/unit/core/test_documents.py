"""Documents of XML and JSON that others write."""

import pytest
from rows import each_row, must_refuse

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.formats.documents import check_nesting, check_xml, parse_json, parse_toml

#: Nine levels of ten references each, of a billion letters.
LAUGHS = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10))


@each_row(
    ('<!DOCTYPE a [<!ENTITY e "&#60;include/>">]><a>&e;</a>', "a DOCTYPE"),
    (f'<!DOCTYPE a [<!ENTITY e0 "x">{LAUGHS}]><a>&e9;</a>', "a DOCTYPE"),
    ('<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', "a DOCTYPE"),
    ("<?include part.xml?><a/>", "a processing instruction"),
    ("<a><?x?></a>", "a processing instruction"),
    ("<a>&e;</a>", "not well-formed XML: undefined entity"),
    ("<a>", "not well-formed XML"),
    ("", "not well-formed XML"),
)
@each_row(str, lambda text: text.encode("utf-16"))
def test_xml_holds_elements_attributes_and_comments(encode, text, what):
    """The search for ``<!DOCTYPE`` in the bytes of a file does not find it in UTF-16."""
    with pytest.raises(UserError, match=rf"^a file (holds|is) {what}"):
        check_xml(encode(text), "a file")


def test_plain_xml_is_let_through_and_one_that_cannot_be_encoded_is_not():
    check_xml('<?xml version="1.0" encoding="UTF-8"?><!-- a --><a b="c"><d>e &amp; &#955;</d></a>', "a file")
    must_refuse("a file is not well-formed XML", check_xml, "<a b='\ud800'/>", "a file")


@each_row(120, 300, 480, 600, 5000)
def test_deep_documents_are_refused(depth):
    nested = "[" * depth + "]" * depth
    must_refuse("a text is nested more than 100 deep", parse_json, nested, "a text")
    must_refuse("a file is nested more than 100 deep", parse_toml, f"a = {nested}", "a file")


def test_nesting_is_counted():
    nested: object = 1
    for _ in range(100):
        nested = {"a": [nested]} if isinstance(nested, list) else [nested]
    must_refuse("x is nested more than 100 deep", check_nesting, nested, "x")
    check_nesting({"a": [[1], {"b": "text"}], "c": "[" * 200}, "x")
