"""A stand-in for Grafana: checks the files and variables that Compose gives it, and answers what up_check.py requests.

It ends with an error if Grafana could not use them. Only Debian's python3-yaml is needed.
"""

from __future__ import annotations

import base64
import json
import os
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import yaml

PROVISIONING = Path("/etc/grafana/provisioning")


def provisioned(kind: str) -> list[dict[str, Any]]:
    """Returns the entries of all provisioning files of one kind."""
    files = [yaml.safe_load(path.read_text()) for path in sorted((PROVISIONING / kind).glob("*.yaml"))]
    if any(content["apiVersion"] != 1 for content in files):
        raise ValueError(f"a file in {PROVISIONING / kind} does not have apiVersion 1")
    return [entry for content in files for entry in content["datasources" if kind == "datasources" else "providers"]]


def main() -> None:
    """Reads what Grafana would read, and serves."""
    password = Path(os.environ["GF_SECURITY_ADMIN_PASSWORD__FILE"]).read_text().strip()
    sources = {source["uid"]: source["url"] for source in provisioned("datasources")}
    folders = [Path(provider["options"]["path"]) for provider in provisioned("dashboards")]
    dashboards = [json.loads(path.read_text()) for folder in folders for path in folder.glob("*.json")]
    home = json.loads(Path(os.environ["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"]).read_text())
    if home not in dashboards:
        raise ValueError("the home dashboard is not provisioned")
    Path("/var/lib/grafana/grafana.db").write_text("")
    Path("/tmp/writable").write_text("")  # noqa: S108 - a tmpfs of the container

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path == "/api/health":
                return self.answer(200, {"database": "ok"})
            expected = "Basic " + base64.b64encode(f"admin:{password}".encode()).decode()
            if self.headers.get("Authorization") != expected:
                return self.answer(401, {"message": "Invalid username or password"})
            if self.path == "/api/search?type=dash-db":
                return self.answer(200, [{"uid": each["uid"], "title": each["title"]} for each in dashboards])
            prefix, _, query = self.path.partition("/api/datasources/proxy/uid/")
            uid, _, path = query.partition("/")
            if prefix or uid not in sources:
                return self.answer(404, {"message": "Not found"})
            with urlopen(f"{sources[uid]}/{path}", timeout=5.0) as response:  # noqa: S310 - from the provisioning
                return self.answer(200, json.load(response))

        def do_HEAD(self) -> None:
            self.send_response(200 if self.path == "/api/health" else 404)
            self.end_headers()

        def answer(self, status: int, content: Any) -> None:
            body = json.dumps(content).encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

    ThreadingHTTPServer(("", 3000), Handler).serve_forever()


if __name__ == "__main__":
    main()
