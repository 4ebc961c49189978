"""Skin files: what is read, and what is said about a wrong one."""

import importlib.resources
from dataclasses import replace
from itertools import permutations

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.toml import read_text

TEXT = importlib.resources.files("jaxeit").joinpath("skin/skins/testbed.toml").read_text()


def test_the_testbed(skin):
    assert skin.name == "testbed"
    assert skin.domain.area == pytest.approx(0.04)
    assert len(skin.electrodes) == 25
    assert len(skin.pads) == 4
    assert skin.protocol.readings == 550
    assert skin.protocol.frame_time == pytest.approx(5.5e-3)
    steps = np.linalg.norm(np.diff(skin.electrode_positions, axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.04)  # a snake: every number next to its neighbour


def test_a_copied_and_edited_file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(TEXT.replace('name = "testbed"', 'name = "mine"').replace("radius = 0.003", "radius = 0.004"))
    skin = je.load_skin(path)
    assert (skin.name, skin.electrodes[0].radius) == ("mine", 0.004)
    assert skin.toml == path.read_text()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("radius = 0.003", "raduis = 0.003", r"\[electrodes\]: radius: missing"),
        ("radius = 0.003", "radius = 0.003\nfoo = 1", r"foo: unknown key"),
        ("radius = 0.003", "radius = -1.0", r"radius: is -1.0; give the contact radius"),
        ("radius = 0.003", 'radius = "3 mm"', r"radius: is '3 mm'"),
        ("radius = 0.003", "radius = nan", "radius: is nan"),
        ("size = [0.2, 0.2]", "size = [0.2]", r"\[sheet\]: size: has 1 numbers"),
        ('kind = "bolt"', 'kind = "screw"', 'give one of "bolt"'),
        ('pattern = "adjacent"', "rows = [[0, 1, 2, 99]]", "names an electrode outside 0 to 24"),
        ('pattern = "adjacent"', 'pattern = "adjacnt"', r"\[protocol\]: pattern: 'adjacnt' is no pattern; give \"trig"),
        ('pattern = "adjacent"', 'pattern = "trig"', 'pattern: \'trig\' is no pattern; give "trigonometric", "adj'),
        ('pattern = "adjacent"', 'pattern = "skip-12"', "pattern: pairs of 25 electrodes can skip 0 to 11, got 12"),
        ('pattern = "adjacent"', "pattern = 3", "pattern: is 3; give"),
        ('pattern = "adjacent"', "rows = [[0, 0, 2, 3]]", "uses one electrode twice"),
        (
            "pitch = 0.04",
            "pitch = 0.06",
            "grid: electrode 4 at .* lies outside the sheet, .*; give pitch and origin",
        ),
        (
            "rectangle = [0.0, 0.0, 0.1, 0.1]",
            "rect = [0, 0, 1, 1]",
            r"polygon: missing; give rectangle = \[x0, y0, x1, y1\] in m",
        ),
        ("sheet_resistance", "sheet_resistence", "missing; give ohm .*; is 'sheet_resistence' a misspelling of it?"),
        (
            "size = [0.2, 0.2]",
            "size = [200, 200]",
            r"\[sheet\]: size: the sheet is 200 m across, more than 20 m; give lengths in m",
        ),
        (
            "[electrodes.grid]",
            "positions = [[0.1, 0.1]]\n[electrodes.grid]",
            "positions: .* have a grid too; give",
        ),
        (
            "rectangle = [0.1, 0.1, 0.2, 0.2]",
            "rectangle = [0.3, 0.1, 0.4, 0.2]",
            "no part of the pad lies on the",
        ),
        ("current = 1e-3", "current = 0", "current"),
        (
            "radius = 0.003",
            "radius = 3e-6",
            r"\[electrodes\]: radius: is 3e-06 m, too little for electrodes of a sheet of",
        ),
        ("version = 1", "version = 2", "version: is 2"),
        ('format = "jaxeit-skin"', 'format = "other"', "format"),
        ("rectangle = [0.0, 0.0, 0.1, 0.1]", "rectangle = [0.1, 0.0, 0.0, 0.1]", r"\[\[pads\]\] number 1"),
        ("rectangle = [0.0, 0.0, 0.1, 0.1]", "rectangle = [0.0, 0.0, 100.0, 0.1]", "reaches 99.8 m beyond the sheet"),
        ("[0.0, 0.0, 0.1, 0.1]", "[0.0, 0.0, 1e-5, 0.1]", "is 1e-05 m wide, too little for a pad of this sheet"),
        ("[0.0, 0.0, 0.1, 0.1]", "[0.1, 0.1, 0.2, 0.2]", "100 % of pad 'lower left' or 'upper right' lie within the o"),
        ('name = "lower left"', 'name = "lower right"', "2 pads have the name 'lower right'; give each pad its own"),
        ('name = "lower left"', 'name = " lower  right"', "2 pads have the name 'lower right'; give each pad its own"),
        ('name = "lower left"', 'name = " "', r"\[\[pads\]\] number 1: name: is ' '; give the pad's name"),
        ("[sheet]", "[sheet", "not valid TOML"),
        ("maximum = 34474.0", "maximum = -1.0", r"\[pressure_sensor\]: maximum"),
    ],
)
def test_a_wrong_file_names_key_and_reason(old, new, message):
    assert old in TEXT
    with pytest.raises(je.toml.TomlError, match=message) as caught:
        je.skin.parse_skin(TEXT.replace(old, new, 1), "mine.toml")
    assert str(caught.value).startswith("mine.toml: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("resistance", [0.0, -200.0, float("nan"), float("inf")])
def test_a_sheet_conducts(resistance):
    skin = je.load_skin("testbed")
    with pytest.raises(je.skin.SkinError, match=r"sheet_resistance is .*; give ohm per square, above zero"):
        replace(skin, sheet_resistance=resistance)


def test_a_missing_file_says_what_is_shipped():
    with pytest.raises(je.toml.TomlError, match="shipped are chest, testbed"):
        je.load_skin("tesbed")


def test_edge_electrodes_and_points():
    text = TEXT[: TEXT.index("[electrodes]")] + TEXT[TEXT.index("[protocol]") :]
    edge = text + '[electrodes]\nkind = "edge"\ncount = 16\nwidth = 0.01\ncontact = 1e-3\n'
    skin = je.skin.parse_skin(edge)
    assert len(skin.electrodes) == 16
    np.testing.assert_allclose(skin.electrode_positions[0], [0, 0], atol=1e-12)
    places = [[0.05, 0.05], [0.15, 0.05], [0.15, 0.15], [0.05, 0.15]]
    points = f'{text}[electrodes]\nkind = "point"\npositions = {places}\n'
    assert je.skin.parse_skin(points).protocol.readings == 4


def _with_electrodes(lines):
    return TEXT[: TEXT.index("[electrodes]")] + TEXT[TEXT.index("[protocol]") :] + f"[electrodes]\n{lines}\n"


RECTANGLES = """kind = "rectangle"
size = [0.02, 0.01]
angle = 0.3
contact = 1e-5
positions = [[0.05, 0.05], [0.15, 0.05], [0.15, 0.15], [0.05, 0.15]]"""

POLYGONS = """kind = "polygon"
contact = 0.0
outlines = [[[0.01, 0.01], [0.01, 0.03], [0.03, 0.01]], [[0.1, 0.1], [0.12, 0.1], [0.12, 0.12], [0.1, 0.12]],
            [[0.15, 0.1], [0.17, 0.1], [0.17, 0.12]], [[0.15, 0.15], [0.17, 0.15], [0.17, 0.17]]]"""


def test_rectangles_are_turned_about_their_centres():
    skin = je.skin.parse_skin(_with_electrodes(RECTANGLES))
    np.testing.assert_allclose(skin.electrode_positions[3], [0.05, 0.15], rtol=1e-14)
    first = skin.electrodes[0]
    assert (first.outline.area, first.contact) == (pytest.approx(2e-4), 1e-5)
    bottom = first.outline.corner_points[1] - first.outline.corner_points[0]  # counter-clockwise from the x axis
    np.testing.assert_allclose(bottom, 0.02 * np.array([np.cos(0.3), np.sin(0.3)]), rtol=1e-12)
    row = 'kind = "rectangle"\nsize = [0.02, 0.01]\ncontact = 0.0\n'
    grid = je.skin.parse_skin(
        _with_electrodes(row + "grid = {columns = 4, rows = 1, pitch = 0.04, origin = [0.04, 0.1]}")
    )
    assert grid.electrodes[1].outline.bounds == (pytest.approx((0.07, 0.095)), pytest.approx((0.09, 0.105)))


def test_polygons():
    skin = je.skin.parse_skin(_with_electrodes(POLYGONS))
    assert [len(e.outline.corner_points) for e in skin.electrodes] == [3, 4, 3, 3]
    np.testing.assert_allclose(skin.electrode_positions[0], [0.05 / 3, 0.05 / 3], rtol=1e-12)


@pytest.mark.parametrize(
    ("lines", "old", "new", "message"),
    [
        (
            RECTANGLES,
            "size = [0.02, 0.01]",
            "size = [0.02, 0.0]",
            r"\[electrodes\]: size: is \[0.02, 0.0\]; give a width",
        ),
        (RECTANGLES, "size = [0.02, 0.01]", "radius = 0.01", r"size: missing; give \[width, height\] in m"),
        (RECTANGLES, "[0.15, 0.05]", "[0.195, 0.05]", r"positions: electrode 1 has a corner at \[0.2.* m, outside"),
        (RECTANGLES, "angle = 0.3", "angle = '17 deg'", "angle: is '17 deg'; give the turn counter-clockwise in rad"),
        (RECTANGLES, "angle = 0.3", "angle = 45", "angle: is 45; give the turn .* in rad, at most a whole one"),
        (RECTANGLES, "contact = 1e-5", "contact = -1.0", "contact: is -1.0; give ohm m.2"),
        (
            RECTANGLES,
            "contact = 1e-5",
            "contact = 1e6",
            r"contact: is 1e\+06 ohm m.2, which conducts .* 0 to 10000 ohm",
        ),
        (RECTANGLES, "angle = 0.3", "angel = 0.3", "angel: unknown key; did you mean 'angle'"),
        (
            POLYGONS,
            "[0.01, 0.01]",
            "[-0.01, 0.01]",
            r"outlines: electrode 0 has a corner at \[-0.01, 0.01\] m, outside",
        ),
        (POLYGONS, "[0.1, 0.12]", "[0.11, 0.09]", "outlines: electrode 1: Polygon: the sides .* meet"),
        (POLYGONS, "[0.1, 0.12]", "[nan, 0.09]", "outlines: electrode 1: Polygon: vertex 3 .* give finite metres"),
        (POLYGONS, "[0.1, 0.12]", "[0.1, '0.12']", r"outlines: is .*; give \[\[\[x, y\], ...\], ...\]"),
        (POLYGONS, "outlines = [[[0.01, 0.01]", "outlines = [[0.01, [0.01, 0.01]", "outlines: is .*; give"),
    ],
)
def test_wrong_patches_are_refused(lines, old, new, message):
    assert old in lines
    with pytest.raises(je.toml.TomlError, match=message):
        je.skin.parse_skin(_with_electrodes(lines.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("name", "readings", "drives"),
    [("adjacent", 32 * 29, 32), ("skip-3", 32 * 29, 32), ("skip-14", 32 * 29, 32), ("opposite", 16 * 28, 16)],
)
def test_named_patterns_never_sense_what_they_drive(name, readings, drives):
    pattern = je.skin.named_pattern(name, 32)
    assert (pattern.shape, len(np.unique(pattern[:, :2], axis=0))) == ((readings, 4), drives)
    assert (pattern[:, :2, None] != pattern[:, None, 2:]).all()
    assert ((je.skin.reciprocal_rows(pattern) >= 0).all()) == (name != "opposite")
    apart = (pattern[:, [1, 3]] - pattern[:, [0, 2]]) % 32
    step = {"adjacent": 1, "skip-3": 4, "skip-14": 15, "opposite": 16}[name]
    assert (apart == [step, 1 if name == "opposite" else step]).all()
    assert len(np.unique(_without_order(pattern), axis=0)) == readings // (1 if name == "opposite" else 2)


def _without_order(pattern):
    """The same row for readings that differ by reciprocity or sign only."""
    pairs = np.sort(pattern.reshape(-1, 2, 2), 2)
    swap = (pairs[:, 0, 0] > pairs[:, 1, 0])[:, None, None]
    return np.where(swap, pairs[:, ::-1], pairs).reshape(-1, 4)


def test_all_pairs_are_every_reading_once():
    pattern = je.skin.all_pairs(7)
    every = list(permutations(range(7), 4))
    np.testing.assert_array_equal(np.unique(_without_order(np.array(every)), axis=0), np.unique(pattern, axis=0))
    assert len(pattern) == len(every) / 8
    assert len(je.skin.all_pairs(25)) == 37_950


def test_a_skin_file_names_its_pattern():
    skin = je.skin.parse_skin(TEXT.replace('"adjacent"', '"skip-3"', 1))
    np.testing.assert_array_equal(skin.protocol.pattern, je.skin.skip(25, 3))


def test_a_skin_file_names_the_trigonometric_pattern(tmp_path):
    """It keeps its scan when its electrodes are moved and the text is read again, and gives it up for rows."""
    text = TEXT.replace('"adjacent"', '"trigonometric"', 1)
    skin = je.skin.parse_skin(text)
    assert (skin.protocol.readings, skin.protocol.current) == (24 * 25, 1e-3)
    path = tmp_path / "other.toml"
    path.write_text(je.skin.with_positions(skin, skin.electrode_positions).toml)
    marks = {je.skin.skin_hash(je.load_skin(path)), je.skin.skin_hash(skin)}
    assert len(marks) == 1
    assert marks.isdisjoint({je.skin.skin_hash(je.skin.parse_skin(TEXT))})
    assert je.skin.with_rows(skin, ROWS).protocol.mixing is None
    with pytest.raises(je.skin.ProtocolError, match=r"a session needs one pair .* or a pattern such as"):
        skin.protocol.rows("a session")
    with pytest.raises(je.skin.ProtocolError, match="no rows of four electrodes; use named_protocol"):
        je.skin.named_pattern("trigonometric", 25)


def test_readings_of_one_drive_are_taken_at_once(tmp_path):
    """22 readings of each of 25 drives, eight at once: three slots, the last with six; the hash counts them."""
    text = TEXT.replace('"adjacent"', '"adjacent"\nsense_channels = 8  # amplifiers', 1)
    skin = je.skin.parse_skin(text)
    slots = skin.protocol.slots.reshape(25, 22)
    np.testing.assert_array_equal(slots[0], [*8 * [0], *8 * [1], *6 * [2]])
    np.testing.assert_array_equal(slots, slots[0] + 3 * np.arange(25)[:, None])
    assert skin.protocol.frame_time == pytest.approx(75e-5)
    assert je.scan.scan_time(skin.protocol, 2.0) == pytest.approx((75 + 50) * 1e-5)
    np.testing.assert_allclose(skin.protocol.reading_offsets, 1e-5 * slots.ravel())
    path = tmp_path / "other.toml"
    path.write_text(je.skin.with_rows(skin, skin.protocol.pattern).toml)
    assert je.skin.skin_hash(je.load_skin(path)) == je.skin.skin_hash(skin)
    assert je.skin.skin_hash(skin) != je.skin.skin_hash(je.skin.parse_skin(TEXT))
    one = je.skin.with_rows(skin, skin.protocol.pattern, 1)
    assert je.skin.skin_hash(one) == je.skin.skin_hash(je.skin.parse_skin(TEXT))
    assert "amplifiers" not in one.toml
    with pytest.raises(je.toml.TomlError, match="a protocol of matrices has no driven pairs"):
        je.skin.parse_skin(text.replace("adjacent", "trigonometric", 1))
    with pytest.raises(je.toml.TomlError, match="sense_channels: is 0"):
        je.skin.parse_skin(text.replace("channels = 8", "channels = 0"))


@pytest.mark.parametrize("electrodes", [4, 9, 16])
def test_trigonometric_currents_are_orthogonal(electrodes):
    """They span all currents that sum to zero."""
    current = je.skin.trigonometric(electrodes)
    assert current.shape == (electrodes, electrodes - 1)
    gram = current.T @ current
    np.testing.assert_allclose(gram, np.diag(np.diag(gram)), atol=1e-12)
    np.testing.assert_allclose(current.sum(0), 0, atol=1e-12)
    assert np.linalg.matrix_rank(current) == electrodes - 1


@pytest.mark.parametrize("current", ["1 mA", 0.0, float("nan")])
def test_a_current_that_is_no_positive_number_is_refused(current):
    with pytest.raises(je.skin.ProtocolError, match=r"the current is .*; give a positive number, A"):
        je.Protocol(ROWS, current)


@pytest.mark.parametrize("current", [np.full(8, 1e-3), [1e-3]])
def test_a_current_for_each_reading_is_refused(current):
    with pytest.raises(je.skin.ProtocolError, match=r"the current has shape .*; give one number, A, for all readings"):
        je.Protocol(je.skin.adjacent(8), current=current)


def test_what_is_not_text_or_cannot_be_read_is_named(tmp_path):
    with pytest.raises(je.toml.TomlError, match=r"cannot be read \(.*\); check the name and the folder"):
        read_text(tmp_path)
    (tmp_path / "skin.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(je.toml.TomlError, match=r"skin\.toml: is not text; give a TOML file"):
        read_text(tmp_path / "skin.toml")


ROWS = np.array([[0, 6, 1, 7], [0, 6, 12, 18], [3, 9, 4, 10]])


@pytest.mark.parametrize(
    "scan", ['pattern = "adjacent"', "rows = [\n  [0, 1, 2, 3],  # [the] first ]\n  [4, 5, 6, 7]\n]"]
)
def test_a_skin_with_other_rows_keeps_all_other_lines(tmp_path, scan):
    skin = je.skin.parse_skin(TEXT.replace('pattern = "adjacent"', scan, 1))
    path = tmp_path / "other.toml"
    path.write_text(je.skin.with_rows(skin, ROWS).toml)
    other = je.load_skin(path)
    np.testing.assert_array_equal(other.protocol.pattern, ROWS)
    gone = set(skin.toml.splitlines()) - set(other.toml.splitlines())
    assert len(gone) == len(scan.splitlines())
    np.testing.assert_array_equal(
        je.skin.with_rows(other, skin.protocol.pattern).protocol.pattern, skin.protocol.pattern
    )


def test_a_text_whose_rows_cannot_be_replaced_is_refused():
    skin = je.skin.parse_skin(TEXT)
    with pytest.raises(je.toml.TomlError, match=r"no text with a table \[protocol\]"):
        je.skin.with_rows(je.Skin("bare", skin.domain, 1.0, skin.electrodes, skin.protocol), ROWS)
    table = TEXT.index("[protocol]"), TEXT.index("[pressure_sensor]")
    inline = 'protocol = {pattern = "adjacent", current = 1e-3}\n' + TEXT[: table[0]] + TEXT[table[1] :]
    with pytest.raises(je.toml.TomlError, match=r"no text with a table \[protocol\]"):
        je.skin.with_rows(je.skin.parse_skin(inline), ROWS)
    with pytest.raises(je.skin.ProtocolError, match="outside 0 to 24"):
        je.skin.with_rows(skin, ROWS + 10)


def test_electrodes_are_moved_by_a_shift_of_jax(skin):
    """As docs/electrodes.md does with the shift of a fit."""
    shift = jnp.full((len(skin.electrodes), 2), 1e-3)
    moved = je.skin.with_positions(skin, skin.electrode_positions + shift)
    np.testing.assert_allclose(moved.electrode_positions, skin.electrode_positions + 1e-3, atol=1e-8)


def test_a_skin_is_the_same_whatever_its_text(skin):
    """Comments, names, the order of keys and the form of numbers do not count; everything of the hardware does."""
    mark = je.skin.skin_hash(skin)
    commented = "# mine\n" + TEXT.replace('name = "testbed"', 'name = "mine"')
    assert je.skin.skin_hash(je.skin.parse_skin(commented)) == mark
    assert "current = 1e-3" in TEXT
    assert je.skin.skin_hash(je.skin.parse_skin(TEXT.replace("current = 1e-3", "current = 0.0010"))) == mark
    listed = je.skin.with_positions(skin, skin.electrode_positions)
    assert "[electrodes.grid]" not in listed.toml
    assert je.skin.skin_hash(listed) == mark
    moved = skin.electrode_positions + np.array([1e-6, 0.0])
    others = [
        je.skin.with_positions(skin, moved),
        je.skin.with_rows(skin, skin.protocol.pattern[::-1]),
        je.load_skin("chest"),
        *(je.skin.parse_skin(TEXT.replace(*change)) for change in (("radius = 0.003", "radius = 0.0031"),)),
    ]
    assert len({mark, *map(je.skin.skin_hash, others)}) == 1 + len(others)


@pytest.mark.parametrize(
    ("outline", "said"),
    [
        (((3, 3), (4, 3), (4, 4)), "pad 'a': reaches 3.8 m beyond the sheet; give its corners in m"),
        (((0.3, 0.1), (0.4, 0.1), (0.4, 0.2)), "pad 'a': no part of the pad lies on the sheet"),
        (((0.0, 0.0), (1e-5, 0.0), (1e-5, 0.1)), "pad 'a': is 1e-05 m wide, too little for a pad"),
        (((0.0, 0.0), (0.1, 0.1), (0.1, 0.0), (0.0, 0.1)), "pad 'a': Polygon: the sides from vertices 0 and 2 meet"),
        (
            je.Rectangle(5, 5),
            r"pad 'a': Rectangle is not an outline; give its corners \[\[x, y\], ...\] in m; those of",
        ),
        ("abc", "pad 'a': "),
    ],
)
def test_pads_from_python_are_asked_as_those_of_files(skin, outline, said):
    with pytest.raises(je.skin.SkinError, match=f"^{said}"):
        replace(skin, pads=(je.Pad("a", np.array(outline) if isinstance(outline, tuple) else outline),))


@pytest.mark.parametrize(("given", "stated"), [(None, "NoneType"), (3, "int"), (je.Rectangle(1, 1), "Rectangle")])
def test_what_is_no_name_and_no_path_is_no_skin(given, stated):
    said = rf"load_skin: {stated} is not the name of a shipped skin or a path; give one of them, such as je.load_skin\("
    with pytest.raises(je.toml.TomlError, match=said):
        je.load_skin(given)
