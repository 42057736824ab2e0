"""Open every page of the built documentation site in Chromium, wide and narrow, and list what is broken.

    python -m tools.site.browser_check docs/_build/html --pictures shots index.html gap.html

Broken are images that do not load, errors of scripts, and pages that scroll sideways. `--pictures` also writes a
picture of each named page at both widths. The exit status is 1 where something is broken. Needs playwright and the
Chromium of the system; --build needs the network where the extra `docs` is not installed.
"""

import argparse
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

CHROMIUM = Path("/usr/bin/chromium")
WIDTHS = {1280: 900, 390: 844}
"""Width of the window -> its height [pixels]: a laptop and a phone."""
LOAD_IMAGES = "document.querySelectorAll('img').forEach(image => image.loading = 'eager')"
IMAGES_LOADED = "[...document.images].every(image => image.complete)"
BROKEN_IMAGES = "[...document.images].filter(image => !image.naturalWidth).map(image => image.src)"
EQUATION_FAILURE = "window.MathJax?.startup?.promise?.then(() => '', error => String(error))"
EXCESS_WIDTH = "document.documentElement.scrollWidth - window.innerWidth"


def list_pages(folder: Path) -> list[Path]:
    """Return the pages of a site, without those of its static files."""
    return [f for f in sorted(folder.rglob("*.html")) if not f.relative_to(folder).as_posix().startswith("_")]


def find_faults(folder: Path, pictures: Path | None = None, names: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield one line for every fault of the pages of a site."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        page = browser.new_page()
        errors: list[Any] = []
        page.on("pageerror", lambda error: errors.append(error))
        page.on("requestfailed", lambda request: errors.append(f"{request.url} does not load"))
        for file in list_pages(folder):
            name = file.relative_to(folder).as_posix()
            page.goto(file.resolve().as_uri())
            if failure := page.evaluate(EQUATION_FAILURE):
                errors.append(failure)
            page.evaluate(LOAD_IMAGES)
            page.wait_for_function(IMAGES_LOADED)
            yield from (f"{name}: {str(error).splitlines()[0]}" for error in errors)
            yield from (f"{name}: broken image {image}" for image in page.evaluate(BROKEN_IMAGES))
            errors.clear()
            for width, height in WIDTHS.items():
                page.set_viewport_size({"width": width, "height": height})
                if (excess := page.evaluate(EXCESS_WIDTH)) > 0:
                    yield f"{name} scrolls sideways by {excess} pixels at a width of {width}"
                if pictures and name in names:
                    page.screenshot(path=pictures / f"{name.removesuffix('.html').replace('/', '_')}_{width}.png")
        browser.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="pages of which --pictures writes pictures")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--build", action="store_true", help="first build the site with executed notebooks")
    args = parser.parse_args()
    if args.build:
        subprocess.run(["bash", "tools/docs", "--execute"], check=True)
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
    faults = list(find_faults(args.folder, args.pictures, tuple(args.names)))
    print("\n".join([*faults, f"{len(list_pages(args.folder))} pages, {len(faults)} faults"]))
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
