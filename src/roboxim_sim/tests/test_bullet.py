import subprocess
import sys


def test_pybullet_import_hides_its_greeting_but_not_errors():
    code = (
        "import os, roboxim_sim.bullet as b\nwith b._without_greeting(): os.write(2, b'an error\\n')\nprint('answer')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("answer\n", "an error\n")
