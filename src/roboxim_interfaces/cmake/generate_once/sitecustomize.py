"""Generate only the files that a changed interface file affects: a cache that rosidl's generators lack.

Why it stays: a wheel serves those who change no interface. Who changes one builds the package, and without this file
each of seven generators parses every interface again (Earley) and rewrites every file, so that all are compiled again.
With it a first build spends half the time in the generators, and one after the change of a field a fraction.

The wheel's build puts this folder on PYTHONPATH, so that Python runs this file in every generator. It makes them

- share syntax trees, keyed by the parsed text;
- skip a file whose template, interface, types and generator are unchanged;
- leave a file untouched if its content would not change, so that nothing that depends on it is built again.
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
