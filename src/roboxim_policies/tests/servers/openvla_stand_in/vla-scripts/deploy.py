"""A stand-in for OpenVLA's vla-scripts/deploy.py: its options and its `POST /act`, without a model."""

import argparse
import base64
import json
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

UNNORM_KEYS = ("bridge_orig", "fractal20220817_data")


def decoded(part):
    """Return the array of json_numpy's form."""
    return np.frombuffer(base64.b64decode(part["__numpy__"]), part["dtype"]).reshape(part["shape"])


def act(payload):
    """Return json_numpy's form of an action that depends on the picture."""
    image, instruction = decoded(payload["image"]), payload["instruction"]
    assert image.dtype == np.uint8
    assert image.shape == (224, 224, 3)
    assert payload["unnorm_key"] in UNNORM_KEYS
    assert isinstance(instruction, str)
    action = np.array([0.01 * image.mean() / 255, 0, -0.005, 0, 0, 0.01, 1.0])
    return {"__numpy__": base64.b64encode(action.tobytes()).decode(), "dtype": "<f8", "shape": [7]}


class Handler(BaseHTTPRequestHandler):
    """Answers requests as FastAPI does."""

    protocol_version = "HTTP/1.1"

    def do_POST(self):  # noqa: N802 - the name that http.server calls
        """Answer with an action, or with "error" and status 200, as the genuine server does."""
        body = self.rfile.read(int(self.headers["Content-Length"]))
        try:
            reply = act(json.loads(body))
        except Exception:
            reply = "error"
        data = json.dumps(reply).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_):
        """Write nothing."""


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--openvla_path", required=True)
    parser.add_argument("--host", default="0.0.0.0")
    parser.add_argument("--port", type=int, default=8000)
    options = parser.parse_args()
    ThreadingHTTPServer((options.host, options.port), Handler).serve_forever()
