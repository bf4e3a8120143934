"""Signatures over a release: SSHSIG by an Ed25519 key, which every machine with OpenSSH can verify."""

from __future__ import annotations

import tempfile
from pathlib import Path

from fullswarm.deploy.release import openssh, sums
from fullswarm.errors import ConfigError

NAMESPACE = "fullswarm-release"
"""Ties a signature to its purpose: one for a Git commit by the same key is not one for a release."""
IDENTITY = "fullswarm"


def sign(folder: Path, key: Path) -> None:
    """Sign the checksums of a release with a private key; the same key gives the same bytes.

    Raises
    ------
    ConfigError
        ssh-keygen is missing or refuses.
    """
    text = (folder / sums.FILE).read_bytes()
    made = openssh.run("-q", "-Y", "sign", "-n", NAMESPACE, "-f", str(key), feed=text, why=f"sign with {key}")
    (folder / sums.SIGNATURE).write_bytes(made)


def verify(folder: Path, allowed_signers: str) -> None:
    """Check that a release is signed by one of `allowed_signers` and that every file is what was signed.

    Raises
    ------
    ConfigError
        The signature is missing, foreign or does not fit, or a file was changed, added or lost.
    """
    try:
        text, signature = (folder / sums.FILE).read_bytes(), folder / sums.SIGNATURE
    except OSError as error:
        raise ConfigError("not a whole release: no checksums", where=str(folder), hint="bundle again") from error
    if not signature.is_file():
        raise ConfigError("the release is not signed", where=str(folder), hint="bundle again")
    with tempfile.NamedTemporaryFile("w", encoding="utf-8") as signers:
        signers.write(allowed_signers)
        signers.flush()
        arguments = ("-f", signers.name, "-I", IDENTITY, "-n", NAMESPACE, "-s", str(signature))
        try:
            openssh.run("-Y", "verify", *arguments, feed=text, why="verify the signature")
        except ConfigError as error:
            hint = "signed on another base, or changed since: bundle it here"
            raise ConfigError(error.what, where=str(folder), hint=error.hint or hint) from error
    sums.check(folder)
