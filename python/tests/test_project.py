"""A project from photos to traits."""

import shutil

import pandas
import pytest

import rowgram


def test_a_flight_gives_traits(flight):
    align = flight.result("align")
    assert align.registered == align.images == len(flight.photos)
    traits = flight.result("plots").to_pandas()
    assert len(traits) > 0
    plants = flight.result("locate").to_pandas()
    assert len(plants) == flight.result("locate").plants
    assert flight.report.is_file() and flight.result("ortho").file("ortho.tif").is_file()


def test_layers_open_as_geoparquet(flight):
    geopandas = pytest.importorskip("geopandas")
    pytest.importorskip("pyarrow")
    plots = geopandas.read_parquet(flight.result("plots").file("traits.parquet"))
    assert plots.crs == "OGC:CRS84" and len(plots) > 0
    same = geopandas.read_file(flight.result("plots").file("traits.gpkg")).to_crs("OGC:CRS84")
    assert plots.geometry.iloc[0].equals_exact(same.geometry.iloc[0], tolerance=1e-7)
    assert (plots["plants"] == same["plants"]).all()


def test_crops_need_a_photo_that_shows_the_whole_plot(flight):
    # The field is one plot here, larger than any photo.
    with pytest.raises(rowgram.RowgramError, match="whole"):
        flight.crops(photos_per_plot=2, margin_m=0.1)
    with pytest.raises(rowgram.InputError, match="photos_per_plot"):
        flight.crops(photos_per_plott=2)


def test_targets_are_found_and_printed(flight, tmp_path):
    root = tmp_path / "field"
    shutil.copytree(flight.root, root)
    (root / "marks.csv").write_text("image,label,u_px,v_px\nnowhere.jpg,elsewhere,1,2\n")
    project = rowgram.Project(root)
    result = project.targets(kind="chequered", size_m=0.4)
    assert result.points_found == result.points and result.found > 0.9 * result.sightings
    table = result.to_pandas()
    assert (table.outcome == "found").sum() == result.found and result.file("targets.png").is_file()
    marks = pandas.read_csv(root / "marks.csv")
    assert len(marks) == 1 + result.found and marks.image[0] == "nowhere.jpg", "marks made by hand stay"
    with pytest.raises(rowgram.InputError, match="kind"):
        project.targets(kind="chequred")
    with pytest.raises(rowgram.InputError, match="size_m"):
        project.targets(size=0.4)
    sheet = tmp_path / "sheet.pdf"
    rowgram.print_targets(sheet, "aruco", 0.3, count=2)
    assert sheet.read_bytes().startswith(b"%PDF")
    with pytest.raises(rowgram.InputError, match="exist"):
        rowgram.print_targets(sheet, "aruco", 0.3)


def test_plots_are_laid_out_before_any_photo(tmp_path):
    folder = tmp_path / "field"
    folder.mkdir()
    corners = tmp_path / "corners.csv"
    # 11.1 m to the north: two plots of 5 m and an alley of 1 m.
    corners.write_text("corner,longitude_deg,latitude_deg\nfirst,-86.99,40.47\nalong,-86.99,40.4701\n")
    project = rowgram.Project(folder)
    design = dict(ranges=2, plots_per_range=2, rows_per_plot=2, row_spacing_m=0.76, plot_length_m=5.0, alley_m=1.0)
    result = project.layout(corners, **design)
    assert result.epsg == 32616 and result.refined is None
    plots = result.to_geopandas("plots.gpkg")
    assert len(plots) == 4 and plots.crs.to_epsg() == 32616
    assert plots.area.between(0.9 * 7.6, 1.1 * 7.6).all()
    assert len(result.to_pandas()) == 4
    with pytest.raises(rowgram.InputError, match="exist"):
        project.layout(corners, **design)
    with pytest.raises(rowgram.InputError, match="plot_length_m"):
        project.layout(corners, force=True, ranges=2)
    with pytest.raises(rowgram.InputError, match="either corners or refine"):
        project.layout()


def test_a_season_needs_its_list(tmp_path):
    with pytest.raises(rowgram.RowgramError, match="season.toml"):
        rowgram.season(tmp_path / "season.toml")


def test_what_is_current_is_kept(flight):
    seen = []
    found = flight.run(until="plots", progress=lambda *progress: seen.append(progress))
    done = {entry["stage"]: entry["ending"] for entry in found.stages}
    assert done["align"] == done["locate"] == "kept"


def test_a_stage_takes_options_and_tells_progress(flight, tmp_path):
    seen = []
    other = rowgram.Project(flight.root, results=flight.results)
    result = other.locate(method="kmeans", seed=7, progress=lambda *progress: seen.append(progress))
    assert result.method == "kmeans" and result.plants > 0
    assert "plants.csv" in [path.name for path in result.files]
    with pytest.raises(AttributeError, match="plants"):
        result.plnts
    other.locate()


def test_warnings_are_pythons_own(tmp_path):
    folder = tmp_path / "bare"
    rowgram.synth.flight(folder, "small", photos=False)
    found = rowgram.doctor(folder)
    assert any(entry["severity"] == "error" and "photos" in entry["subject"] for entry in found)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: rowgram.Project(p.root / "nowhere"), "nowhere"),
        (lambda p: rowgram.Project(3), "path"),
        (lambda p: rowgram.Project(p.root, algin={"seed": 1}), "align"),
        (lambda p: rowgram.Project(p.root, align={"seeed": 1}), "seed"),
        (lambda p: rowgram.Project(p.root, ortho={"gsd_m": -0.01}), "gsd_m"),
        (lambda p: p.run(until="plotz"), "plots"),
        (lambda p: p.run(locate=3), "dictionary"),
        (lambda p: p.locate(methd="paper"), "method"),
        (lambda p: p.result("evaluate"), "evaluate"),
        (lambda p: rowgram.options("locat"), "locate"),
    ],
)
def test_what_cannot_be_is_refused(flight, call, message):
    with pytest.raises(rowgram.InputError, match=message):
        call(flight)


def test_options_are_described():
    names = {entry["name"]: entry for entry in rowgram.options("locate")["options"]}
    assert names["gsd_m"]["unit"] == "metres" and names["method"]["default"]
    for section in rowgram.options().values():
        assert all(entry["about"] for entry in section["options"])


def test_an_exception_of_the_callback_comes_through(tmp_path):
    def stop(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rowgram.synth.flight(tmp_path / "field", "small", progress=stop)
