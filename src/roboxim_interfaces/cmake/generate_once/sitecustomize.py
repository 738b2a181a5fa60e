"""Generate only the files that a changed interface file affects.

Rosidl runs seven generators. Whatever changed, each of them parses every interface of a package with a general (Earley)
parser, expands every template and rewrites every file, and all files are then compiled again. The wheel's build puts
this folder on PYTHONPATH. Python then runs this file at startup, which makes the generators

- share syntax trees, keyed by the parsed text;
- skip a file whose template, interface, types and generator are unchanged;
- leave a file untouched if its content would not change, so that nothing that depends on it is built again.

This halves the time that the generators take in a first build. A build after the change of a field takes a fraction
of a full build.
"""

import os
import sys

_FOLDER = os.environ.get("ROBOXIM_GENERATOR_CACHE")


def _install(folder):
    """Wrap rosidl's parser and its template expansion."""
    import contextlib
    import hashlib
    import json
    import pickle
    from pathlib import Path

    import rosidl_pycommon
    from rosidl_parser import parser

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    parse, expand = parser.get_ast_from_idl_string, rosidl_pycommon.expand_template
    parsed = {}

    def digest(*parts):
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()

    def write(path, content):
        whole = path.with_suffix(f".{os.getpid()}")
        whole.write_bytes(content)
        whole.replace(path)

    def parse_once(idl_string):
        parsed["key"] = digest(idl_string)
        path = folder / parsed["key"]
        with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError):
            return pickle.loads(path.read_bytes())
        tree = parse(idl_string)
        write(path, pickle.dumps(tree))
        return tree

    def expand_once(template_name, data, output_file, minimum_timestamp=None, template_basepath=None, **options):
        if template_basepath is None or "type_source_file" not in data:
            return expand(template_name, data, output_file, None, template_basepath, **options)
        others = {name: str(value) for name, value in data.items() if name not in ("content", "type_description_info")}
        key = digest(
            (Path(template_basepath) / template_name).read_text(),
            parsed["key"],
            json.dumps(data["type_description_info"], sort_keys=True),
            Path(data["type_source_file"]).read_text(),
            json.dumps(others, sort_keys=True),
            *(getattr(option, "__qualname__", str(option)) for option in options.values()),
        )
        record = folder / digest(str(Path(output_file).resolve()))
        with contextlib.suppress(OSError):
            if record.read_text() == key and Path(output_file).exists():
                return None
        expand(template_name, data, output_file, None, template_basepath, **options)
        write(record, key.encode())
        return None

    parser.get_ast_from_idl_string = parse_once
    rosidl_pycommon.expand_template = expand_once


if _FOLDER and any("/rosidl_" in argument for argument in sys.orig_argv):
    _install(_FOLDER)
