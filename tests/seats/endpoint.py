"""A fake endpoint for chat completions, which answers as it is told."""

import json
import threading
import time
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


def says(text, finish="stop", **message):
    """Return the body of a completion that says something."""
    return {
        "id": "1",
        "object": "chat.completion",
        "created": 1,
        "model": "fake",
        "choices": [
            {
                "index": 0,
                "finish_reason": finish,
                "message": {"role": "assistant", "content": text, **message},
            }
        ],
        "usage": {"prompt_tokens": 10, "completion_tokens": 3, "total_tokens": 13},
    }


def fails(status, text="no", **headers):
    """Return an error with a status."""
    return status, {"error": {"message": text}}, headers


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_POST(self):
        request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        request["key"] = self.headers.get("Authorization")
        request["port"] = self.client_address[1]
        self.server.requests.append(request)
        answer = self.server.answer(request)
        if isinstance(answer, float):
            time.sleep(answer)
            answer = says('{"action": "open"}')
        status, body, headers = answer if isinstance(answer, tuple) else (200, answer, {})
        text = body if isinstance(body, str) else json.dumps(body)
        self.send_response(status)
        self.send_header(
            "Content-Type", "text/html" if isinstance(body, str) else "application/json"
        )
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(text.encode())))
        self.end_headers()
        self.wfile.write(text.encode())

    def log_message(self, *args):
        pass


def _in_turn(answers, request):
    return answers.pop(0) if len(answers) > 1 else answers[0]


@contextmanager
def endpoint(answers):
    """Serve one answer per request, and repeat the last one; a number of seconds is a delay.

    ``answers`` may be a callable of the request.
    """
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    server.daemon_threads = True
    server.requests = []
    server.answer = answers if callable(answers) else partial(_in_turn, [*answers])
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/v1", server.requests
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
