"""Adds the completions of the shells and the manual page to a wheel. All else about the build is in pyproject.toml.

An editable install gets none of them, and so needs nothing that generates them.
"""

import os
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

#: Where shells and man look, if the environment is /usr/local, or pipx links it.
SHARE = {
    "bash": "share/bash-completion/completions",
    "zsh": "share/zsh/site-functions",
    "fish": "share/fish/vendor_completions.d",
}


class BuildWithShellFiles(build_py):
    """Generates them beside the modules that it has copied."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        sys.path.insert(0, str(Path(__file__).parent))
        os.environ["COLUMNS"] = "100"  # of the manual page
        from rass_mav.cli import build_parser
        from rass_mav.commands.completion import FILES
        from rass_mav.commands.shell_files import manual, script

        directory = Path(self.build_lib, "rass_mav", "commands", "shell")
        directory.mkdir(exist_ok=True)
        for shell, name in FILES.items():
            self._add(directory / name, script(shell, build_parser()), SHARE[shell])
        self._add(directory / "rass-mav.1", manual(build_parser()), "share/man/man1")

    def _add(self, file: Path, text: str, share: str) -> None:
        file.write_text(text, encoding="utf-8")
        self.distribution.data_files.append((share, [str(file)]))


setup(cmdclass={"build_py": BuildWithShellFiles})
