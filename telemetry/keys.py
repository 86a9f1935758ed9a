"""Certificates of the bus: who may join, and as what.

One authority per installation signs a certificate for every role; its common name is the role, and the access list of
the router (`telemetry.bus.security`) goes by it. The authority's own key is needed only to sign more of them::

    FOLDER/ca.pem                 what everybody checks the others against
    FOLDER/ROLE.pem, ROLE.key     of each role; a machine needs ca.pem and those of its own roles, and nothing else
    FOLDER/authority/ca.key       stays where it was made
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

ROLES = ("router", "ingest", "estimate", "record", "viewer")
HOSTS = ("localhost", "127.0.0.1")
DAYS = 365
SOON = timedelta(days=14)
_AUTHORITY_DAYS = 3650
_BACK = timedelta(hours=1)  # clocks of other machines may be late


def create(folder: Path, names: Sequence[str] = ROLES, hosts: Sequence[str] = HOSTS, days: float = DAYS) -> list[Path]:
    """Make certificates, and the authority that signs them if the folder has none.

    Elliptic curve P-256, signed with SHA-256, good for servers and clients. Keys are readable by their owner alone.

    Parameters
    ----------
    folder : Path
        Made if it is not there.
    names : sequence of str
        Common names, the roles.
    hosts : sequence of str
        Names and addresses at which the router is called; they stand in every certificate.
    days : float
        How long they are good for.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    FileExistsError
        If one of them is there: nothing is overwritten, and nothing has been written then.
    ValueError
        If a name or host is none, or `days` more than the authority's own.
    """
    if not -_AUTHORITY_DAYS <= days <= _AUTHORITY_DAYS:
        raise ValueError(f"{days} days: certificates are good for at most {_AUTHORITY_DAYS} days")
    alternatives = [_alternative(host) for host in hosts]
    if not alternatives:
        raise ValueError("certificates need a host: the name or address at which the router is called")
    for name in names:
        if not name.replace("-", "").replace("_", "").isalnum() or not name.isascii() or name in ("ca", "authority"):
            raise ValueError(f"{name!r} is no name for a certificate: letters, digits, - and _")
    authority = folder / "authority" / "ca.key"
    new = not authority.exists()
    wanted = [folder / "ca.pem"] if new else []
    wanted += [folder / f"{name}.{kind}" for name in names for kind in ("pem", "key")]
    for path in wanted:
        if path.exists():
            raise FileExistsError(f"{path} exists, and keys are never overwritten: choose another folder or name")
    now = datetime.now(UTC)
    written = []
    signer: ec.EllipticCurvePrivateKey
    if new:
        authority.parent.mkdir(parents=True, mode=0o700)
        signer = ec.generate_private_key(ec.SECP256R1())
        issuer = _authority(signer, now)
        written += [_write(authority, _pem(signer), 0o600), _write(folder / "ca.pem", _text(issuer), 0o644)]
    else:
        loaded = serialization.load_pem_private_key(authority.read_bytes(), None)
        issuer = _certificate(folder / "ca.pem")
        if not isinstance(loaded, ec.EllipticCurvePrivateKey) or loaded.public_key() != issuer.public_key():
            raise ValueError(f"{authority} is not the key of {folder / 'ca.pem'}: choose another folder")
        signer = loaded
    for name in names:
        key = ec.generate_private_key(ec.SECP256R1())
        signed = (
            x509.CertificateBuilder()
            .subject_name(_name(name))
            .issuer_name(issuer.subject)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - _BACK)
            .not_valid_after(max(min(now + timedelta(days=days), issuer.not_valid_after_utc), now - _BACK))
            .add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(
                x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
                critical=False,
            )
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
            .sign(signer, hashes.SHA256())
        )
        written += [
            _write(folder / f"{name}.key", _pem(key), 0o600),
            _write(folder / f"{name}.pem", _text(signed), 0o644),
        ]
    return written


def problem(folder: Path, role: str) -> str | None:
    """Why the certificate of a role cannot be used, or None: missing, damaged, of another authority, out of date."""
    paths = [folder / "ca.pem", folder / f"{role}.pem", folder / f"{role}.key"]
    for path in paths:
        if not path.is_file():
            return f"{path} is not there: make it with sortie keys {folder}, or copy it from where it was made"
        if not os.access(path, os.R_OK):
            return f"{path} cannot be read by this user"
    try:
        issuer, own = _certificate(paths[0]), _certificate(paths[1])
        key = serialization.load_pem_private_key(paths[2].read_bytes(), None)
    except (ValueError, TypeError) as error:
        return f"{folder}: a certificate or key of {role} is damaged: {str(error).splitlines()[0]}"
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != own.public_key():
        return f"{paths[2]} is not the key of {paths[1]}"
    try:
        own.verify_directly_issued_by(issuer)
    except (ValueError, TypeError, InvalidSignature):
        return f"{paths[1]} was not signed by the authority in {paths[0]}"
    common = [str(part.value) for part in own.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
    if common != [role]:
        return f"{paths[1]} is made out to {', '.join(common) or 'nobody'}, not to {role}"
    now = datetime.now(UTC)
    for path, certificate in ((paths[1], own), (paths[0], issuer)):
        if now > certificate.not_valid_after_utc:
            return f"{path} expired on {certificate.not_valid_after_utc:%Y-%m-%d %H:%M} UTC: make a new one"
        if now < certificate.not_valid_before_utc:
            return (
                f"{path} is not valid before {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC: "
                "is the clock of this machine right?"
            )
    return None


def warning(folder: Path, role: str) -> str | None:
    """What should be done about the certificate of a role soon, or None: it expires within 14 days, or its key can be
    read by others.
    """
    certificate, key = folder / f"{role}.pem", folder / f"{role}.key"
    end = _certificate(certificate).not_valid_after_utc
    if end - datetime.now(UTC) < SOON:
        return f"{certificate} expires on {end:%Y-%m-%d %H:%M} UTC: make a new one before then"
    if key.stat().st_mode & 0o077:
        return f"{key} can be read by others: chmod 600 {key}"
    return None


def _authority(key: ec.EllipticCurvePrivateKey, now: datetime) -> x509.Certificate:
    name = _name("sortie authority")
    usage = dict.fromkeys(
        (
            "digital_signature",
            "content_commitment",
            "key_encipherment",
            "data_encipherment",
            "key_agreement",
            "encipher_only",
            "decipher_only",
        ),
        False,
    )
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACK)
        .not_valid_after(now + timedelta(days=_AUTHORITY_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.KeyUsage(key_cert_sign=True, crl_sign=True, **usage), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    if not host or not host.isascii() or not all(part and len(part) < 64 for part in host.split(".")):
        raise ValueError(f"{host!r} is neither an address nor the name of a host")
    if not host.replace("-", "").replace(".", "").isalnum():
        raise ValueError(f"{host!r} is neither an address nor the name of a host")
    return x509.DNSName(host)


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _certificate(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def _text(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _write(path: Path, content: bytes, mode: int) -> Path:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(content)
    return path
