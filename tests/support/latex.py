"""Compilation of LaTeX tables in a paper of two columns."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

requires_pdflatex = pytest.mark.skipif(
    shutil.which("pdflatex") is None,
    reason="requires pdflatex (Debian packages texlive-latex-base and texlive-latex-recommended)",
)


def log_of_paper(folder: Path, table: str, *labels: str) -> str:
    """Compile a minimal paper with a table file and references to `labels` in `folder`, and return the log.

    The packages are those that the first line of the table lists.
    """
    packages = "\n".join(re.findall(r"\\usepackage\{\w+\}", table.splitlines()[0]))
    references = " ".join(f"\\ref{{{label}}}" for label in labels)
    body = f"\\begin{{document}}\n{table}\n{references}\n\\end{{document}}\n"
    (folder / "paper.tex").write_text(f"\\documentclass[twocolumn]{{article}}\n{packages}\n{body}")
    line = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    for _ in range(2):  # the second run resolves the references
        done = subprocess.run(line, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stdout[-4000:]
    return (folder / "paper.log").read_text(errors="replace")
