from html.parser import HTMLParser

from lio_jax.viz import html

EVIL = '<script>alert("1")</script> & "quoted" \'names\''


class Outline(HTMLParser):
    """Tags and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)

    def handle_data(self, data):
        self.words.append(data)


def test_text_is_text_wherever_it_stands():
    written = html.page(
        EVIL,
        [
            html.section(EVIL, html.paragraph(EVIL), html.bullets([EVIL])),
            html.tiles({EVIL: EVIL}),
            html.table([EVIL], [[EVIL]]),
            html.folded(EVIL, EVIL),
            html.figure(EVIL, "<svg></svg>", EVIL, [(EVIL, 0)]),
        ],
    )
    outline = Outline(written)
    assert "script" not in outline.tags
    assert outline.words.count(EVIL) == 14


def test_a_page_asks_for_nothing_from_outside():
    written = html.page("a", [html.paragraph("b")])
    assert "http:" not in written
    assert "https:" not in written
    assert "default-src 'none'" in written


def test_what_is_empty_is_left_out():
    assert html.section("a", "", "") == html.figures("") == html.bullets([]) == html.paragraph("") == ""
    assert html.tiles({}) == html.folded("a", "") == ""


def test_numbers_stand_to_the_right():
    cells = html.table(["a"], [["1.5 m", "-2", "0.10.2", "1e-3", "x", ""]])
    assert cells.count("class=number") == 3


def test_colours_begin_anew():
    assert html.series_colour(html.SERIES + 1) == html.series_colour(1)
