"""Fixtures of tests in a browser, and of tests of campaigns."""

import pytest
from browser_page import BROWSER, DRIVER, Page
from few_paths import few_paths
from quick_campaign import QUICK

from mitransient_lidar.campaigns import workers
from mitransient_lidar.campaigns.shard import Outcome, render_shard
from mitransient_lidar.plots.gate_viewer.page import page_text


@pytest.fixture(scope="module")
def browser():
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    # Chromium's own renderer draws pages in three dimensions without a graphics processor.
    drawing = ("--disable-gpu", "--enable-unsafe-swiftshader")
    for argument in ("--headless=new", "--no-sandbox", *drawing, "--window-size=1280,800"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    # A given path of the driver avoids a search and a download.
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


@pytest.fixture
def show(browser, tmp_path):
    """Function that writes the page of a stack and opens it; fails if the browser has logged an error."""

    def open_page(stack, result=None, **options):
        (tmp_path / "page.html").write_text(page_text(stack, result, **options), "utf-8")
        browser.get(f"file://{tmp_path}/page.html")
        page = Page(browser)
        page.wait("return document.querySelectorAll('#curve-plot .line').length > 0")
        return page

    yield open_page
    assert browser.get_log("browser") == []
    assert browser.execute_script("return performance.getEntriesByType('resource').map((entry) => entry.name)") == []


@pytest.fixture(scope="session")
def campaign(tmp_path_factory):
    """The quick campaign, of a scene with few paths a pass."""
    return {"scene": str(few_paths("table1", tmp_path_factory.mktemp("scene"))), **QUICK}


@pytest.fixture(scope="session")
def quick(campaign, tmp_path_factory):
    """Store of the quick campaign, rendered in two shards."""
    path = tmp_path_factory.mktemp("campaign") / "quick.zarr"
    from mitransient_lidar.campaigns.sweep import campaign as run_campaign

    run_campaign(campaign, path, workers=1, shard_size=6)
    return path


@pytest.fixture
def in_this_process(monkeypatch):
    """Render shards of campaigns and flights here, where imports, kernels and scenes are; other tests use processes."""

    def render(path, shard, retry, *_):
        found = []
        render_shard(path, shard, retry, {}, set(), lambda **event: found.append(event), lambda: False)
        return Outcome(found[-1]["done"], found[-1]["failed"])

    monkeypatch.setattr(workers, "render_in_process", render)
