"""What goes wrong, all below `RcwmError`."""


class RcwmError(Exception):
    """What a user can put right; its text is one line that says how."""


class InputError(RcwmError, ValueError):
    """What was given does not fit: it says what was found and what is expected."""


class InterfaceError(RcwmError):
    """A text that is no interface: what stands where, and what is expected."""


class PolicyError(RcwmError):
    """There is no policy, or no decision."""


class BundleError(PolicyError):
    """A bundle that was refused."""


class NotFinite(PolicyError):
    """The policy's numbers are not finite; its state is that of the last good tick."""


class LinkError(RcwmError):
    """A link cannot be made or used."""


class SharedMemoryFull(LinkError):
    """No room in `/dev/shm`."""


class LinkTaken(LinkError):
    """The instance has a robot, or a controller, already."""


class DoesNotFit(LinkError):
    """The robot is not what the policy needs; the text says in what."""


class WrongThread(LinkError):
    """An end of a link was used on another thread than the one that opened it."""


class PeerClosed(RcwmError):
    """The other end has said that it sends nothing more: a robot must come to rest."""
