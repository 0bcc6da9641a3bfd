"""The search of the documents works in pages that are opened as files, where browsers start no worker."""

from pathlib import Path
from typing import Any

SCRIPT = Path(__file__).parents[2] / "docs" / "iframe-worker.js"
WORKER = "addEventListener('message', async event => postMessage([event.data, typeof parent.page]))"


def test_a_worker_answers_in_a_page_that_is_a_file(browser_page: Any, tmp_path: Path):
    (tmp_path / "worker.js").write_text(WORKER, "utf-8")
    (tmp_path / "page.html").write_text(f"<body><script src={SCRIPT.as_uri()}></script>", "utf-8")
    browser_page.goto((tmp_path / "page.html").as_uri())
    answer = browser_page.evaluate("""() => new Promise(done => {
        window.page = 1;
        const worker = new Worker("worker.js");
        for (const kind of ["message", "error"]) worker.addEventListener(kind, event => done(event.data));
        worker.postMessage({"query": "latency"});
    })""")
    assert answer == [{"query": "latency"}, "number"]
