"""Certificates that openssl and the eye can check."""

from __future__ import annotations

import shutil
import stat
import subprocess
from datetime import UTC, datetime, timedelta

import pytest
from cryptography import x509

from telemetry import keys


def test_everybody_gets_a_certificate_and_the_authority_keeps_its_key_apart(tmp_path):
    folder = tmp_path / "keys"
    written = keys.create(folder, ["router", "ingest"], ["ground.example", "10.0.0.1", "::1"], 30)
    assert sorted(str(path.relative_to(folder)) for path in written) == [
        "authority/ca.key", "ca.pem", "ingest.key", "ingest.pem", "router.key", "router.pem",
    ]  # fmt: skip
    assert all(path.is_file() for path in written)
    for path in written:
        assert stat.S_IMODE(path.stat().st_mode) == (0o600 if path.suffix == ".key" else 0o644)
    certificate = x509.load_pem_x509_certificate((folder / "router.pem").read_bytes())
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["ground.example"]
    assert [str(one) for one in names.get_values_for_type(x509.IPAddress)] == ["10.0.0.1", "::1"]
    left = certificate.not_valid_after_utc - datetime.now(UTC)
    assert timedelta(days=29, hours=23) < left <= timedelta(days=30)
    assert keys.problem(folder, "router") is None
    assert keys.warning(folder, "router") is None


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
@pytest.mark.parametrize("purpose", ["sslserver", "sslclient"])
def test_openssl_accepts_them_for_both_sides(tmp_path, purpose):
    keys.create(tmp_path, ["router"])
    command = ["openssl", "verify", "-x509_strict", "-purpose", purpose, "-CAfile", tmp_path / "ca.pem"]
    done = subprocess.run([*command, tmp_path / "router.pem"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_nothing_is_overwritten_and_a_name_can_be_added(tmp_path):
    keys.create(tmp_path, ["router"])
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    with pytest.raises(FileExistsError, match=r"router\.pem exists, and keys are never overwritten"):
        keys.create(tmp_path, ["viewer", "router"])
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before, "all or nothing"
    added = keys.create(tmp_path, ["viewer"])
    assert [path.name for path in added] == ["viewer.key", "viewer.pem"]
    assert keys.problem(tmp_path, "viewer") is None
    assert all(path.read_bytes() == content for path, content in before.items())


@pytest.mark.parametrize("name", ["", "a/b", "../x", "ca", "authority", "ä", "a b"])
def test_what_is_no_name_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match="is no name for a certificate"):
        keys.create(tmp_path / "k", [name])
    assert not (tmp_path / "k").exists()


@pytest.mark.parametrize("host", ["", "a b", "x" * 64, "..", "1.2.3.4/8"])
def test_what_is_no_host_is_refused(tmp_path, host):
    with pytest.raises(ValueError, match="is neither an address nor the name of a host"):
        keys.create(tmp_path / "k", hosts=[host])
    with pytest.raises(ValueError, match="certificates need a host"):
        keys.create(tmp_path / "k", hosts=[])


def test_what_is_wrong_with_a_certificate_is_told(tmp_path):
    keys.create(tmp_path / "a", ["ingest", "viewer"])
    keys.create(tmp_path / "b", ["ingest"])
    assert "viewer.pem is not there" in str(keys.problem(tmp_path / "b", "viewer"))
    for suffix in ("pem", "key"):
        (tmp_path / "b" / f"viewer.{suffix}").write_bytes((tmp_path / "a" / f"ingest.{suffix}").read_bytes())
    assert "was not signed by the authority" in str(keys.problem(tmp_path / "b", "viewer"))
    (tmp_path / "b" / "ca.pem").write_bytes((tmp_path / "a" / "ca.pem").read_bytes())
    assert "is made out to ingest, not to viewer" in str(keys.problem(tmp_path / "b", "viewer"))
    assert "ingest.pem was not signed by" in str(keys.problem(tmp_path / "b", "ingest"))
    (tmp_path / "a" / "ingest.key").write_bytes((tmp_path / "a" / "viewer.key").read_bytes())
    assert "ingest.key is not the key of" in str(keys.problem(tmp_path / "a", "ingest"))
    (tmp_path / "a" / "viewer.pem").write_text("no certificate")
    assert "of viewer is damaged" in str(keys.problem(tmp_path / "a", "viewer"))


def test_dates_are_looked_at(tmp_path, monkeypatch):
    keys.create(tmp_path, ["a"], days=13)
    assert "a.pem expires on" in str(keys.warning(tmp_path, "a"))
    (tmp_path / "a.key").chmod(0o644)
    keys.create(tmp_path, ["b"], days=15)
    assert keys.warning(tmp_path, "b") is None
    (tmp_path / "b.key").chmod(0o640)
    assert "b.key can be read by others: chmod 600" in str(keys.warning(tmp_path, "b"))
    keys.create(tmp_path, ["c"], days=-1)
    assert "c.pem expired on" in str(keys.problem(tmp_path, "c"))
    monkeypatch.setattr(keys, "_BACK", -timedelta(hours=2))
    keys.create(tmp_path, ["d"])
    assert "d.pem is not valid before" in str(keys.problem(tmp_path, "d"))
