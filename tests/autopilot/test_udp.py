"""The UDP driver on the loopback: one peer per port, no error for a peer that is not there, no starving."""

from __future__ import annotations

import errno
import itertools
import select
import socket
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field

import pytest

from autopilot.link import udp
from autopilot.link.clock import NS_PER_MS, NS_PER_S, NS_PER_US, Clock
from autopilot.link.node import Record
from autopilot.link.ports import LATCH_SILENCE_NS
from autopilot.link.udp import (
    IDLE_NS,
    MAX_PER_PASS,
    MAX_SPIN_NS,
    MAX_WAIT_NS,
    SPIN_SHARE,
    UdpDriver,
    UdpPort,
    dial,
    listen,
    next_in_turn,
    parse_address,
    true_ns,
)
from gains.table import InputError

HOME = ("127.0.0.1", 0)
TIMEOUT_S = 5.0
MAX_PASSES = 60
BIG_BYTES = 8192
"""A datagram of which a few hundred fill any receive buffer."""

SAMPLE_NS = 25 * NS_PER_MS
TICK_PERIOD_NS = 7 * NS_PER_MS
COST_NS = {"control": 200_000, "ground": 30_000, "tick": 100_000}
"""How long a node works, in virtual time."""


@dataclass
class Probe:
    """A node that logs, echoes if told to, and sends ``beacon`` at every tick."""

    deadline_ns: int | None = None
    echo: bool = False
    beacon: list[tuple[str, bytes]] = field(default_factory=list)
    got: list[tuple[str, bytes, int]] = field(default_factory=list)
    ticks: list[int] = field(default_factory=list)
    out: list[tuple[str, bytes]] = field(default_factory=list)
    made: list[Record] = field(default_factory=list)

    def receive(self, port, datagram, now_ns):
        self.got.append((port, datagram, now_ns))
        if self.echo:
            self.out.append((port, datagram))

    def tick(self, now_ns):
        self.ticks.append(now_ns)
        self.out += self.beacon
        self.made.append(Record("events", now_ns, {}))

    def next_deadline_ns(self):
        return self.deadline_ns

    def outgoing(self):
        out, self.out = self.out, []
        return out

    def records(self):
        made, self.made = self.made, []
        return made


@pytest.fixture
def peer() -> Iterator[socket.socket]:
    with closing(a_socket()) as sock:
        yield sock


@pytest.fixture
def stranger() -> Iterator[socket.socket]:
    with closing(a_socket()) as sock:
        yield sock


def a_socket() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(HOME)
    sock.settimeout(TIMEOUT_S)
    return sock


def passes(count: int, each: Callable[[int], None] = lambda n: None) -> Callable[[], bool]:
    """Return a ``stopping`` that lets the driver make so many passes, calling ``each`` before every one."""
    made = 0

    def stopping() -> bool:
        nonlocal made
        if made >= count:
            return True
        each(made)
        made += 1
        return False

    return stopping


def until(condition: Callable[[], bool]) -> Callable[[], bool]:
    bounded = passes(MAX_PASSES)
    return lambda: condition() or bounded()


def take(port: UdpPort, now_ns: int) -> bytes | None:
    """Wait for a datagram at a port, and take it."""
    assert select.select([port.socket], [], [], TIMEOUT_S)[0]
    return port.receive(now_ns)


def accept_hello(datagram: bytes) -> bool:
    return datagram.startswith(b"hello")


@contextmanager
def deaf() -> Iterator[socket.socket]:
    """Give a socket that refuses everybody: its port is taken, so nobody else can come to listen there."""
    with closing(a_socket()) as sock, closing(a_socket()) as elsewhere:
        sock.connect(elsewhere.getsockname())
        yield sock


# ports


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("127.0.0.1:14600", ("127.0.0.1", 14600)),
        ("udpout:127.0.0.1:14600", ("127.0.0.1", 14600)),
        ("udpin:0.0.0.0:0", ("0.0.0.0", 0)),
        ("[::1]:65535", ("::1", 65535)),
        ("localhost:1", ("localhost", 1)),
    ],
)
def test_addresses_are_read(text, address):
    assert parse_address(text) == address


@pytest.mark.parametrize("text", ["", "127.0.0.1", ":14600", "127.0.0.1:", "h:65536", "h:-1", "h:x", "h:1.5", "h:٣"])
def test_what_is_no_address_is_refused(text):
    with pytest.raises(InputError, match="expected HOST:PORT"):
        parse_address(text)


def test_a_dialling_port_hears_its_one_peer_and_nobody_else(peer, stranger):
    port = dial("p", peer.getsockname())
    with closing(port.socket):
        stranger.sendto(b"forged", port.local)
        peer.sendto(b"true", port.local)
        assert take(port, 0) == b"true"
        assert port.receive(0) is None


def test_a_listening_port_latches_the_first_sender_of_an_accepted_datagram(peer, stranger):
    port = listen("p", HOME, accept=accept_hello)
    with closing(port.socket):
        stranger.sendto(b"nonsense", port.local)
        assert take(port, 1) == b""
        assert (port.peer, port.strangers) == (None, 1)
        peer.sendto(b"hello", port.local)
        assert take(port, 2) == b"hello"
        assert port.peer == peer.getsockname()
        peer.sendto(b"anything", port.local)
        assert take(port, 3) == b"anything"
        assert port.strangers == 1


def test_a_stranger_is_counted_and_not_answered_while_the_peer_speaks(peer, stranger):
    port = listen("p", HOME, accept=accept_hello)
    node = Probe(echo=True)
    with closing(UdpDriver(node, [port], Clock())) as driver:
        peer.sendto(b"hello", port.local)
        stranger.sendto(b"hello too", port.local)
        peer.sendto(b"bye", port.local)
        driver.run(until(lambda: len(node.got) >= 2))
        assert [datagram for _, datagram, _ in node.got] == [b"hello", b"bye"]
        assert (port.strangers, port.peer) == (1, peer.getsockname())
        assert (peer.recv(99), peer.recv(99)) == (b"hello", b"bye")
        stranger.setblocking(False)
        with pytest.raises(BlockingIOError):
            stranger.recv(99)


def test_a_silent_peer_may_be_replaced_just_after_its_time_and_not_before(peer, stranger):
    port = listen("p", HOME, accept=accept_hello)
    with closing(port.socket):
        peer.sendto(b"hello", port.local)
        take(port, 1000)
        stranger.sendto(b"hello", port.local)
        assert take(port, 1000 + LATCH_SILENCE_NS) == b""
        stranger.sendto(b"nonsense", port.local)
        assert take(port, 1001 + LATCH_SILENCE_NS) == b""
        assert port.peer == peer.getsockname()
        stranger.sendto(b"hello", port.local)
        assert take(port, 1001 + LATCH_SILENCE_NS) == b"hello"
        assert port.peer == stranger.getsockname()
        peer.sendto(b"hello", port.local)
        assert take(port, 1002 + LATCH_SILENCE_NS) == b""


def test_a_strangers_noise_does_not_keep_a_dead_peer_latched(peer, stranger):
    port = listen("p", HOME, accept=accept_hello)
    with closing(port.socket):
        peer.sendto(b"hello", port.local)
        take(port, 0)
        for now_ns in range(0, LATCH_SILENCE_NS, NS_PER_S):
            stranger.sendto(b"hello", port.local)
            assert take(port, now_ns) == b""
        stranger.sendto(b"hello", port.local)
        assert take(port, LATCH_SILENCE_NS + 1) == b"hello"


def test_a_port_with_a_given_peer_never_latches_another(peer, stranger):
    port = listen("p", HOME, peer=peer.getsockname(), accept=accept_hello)
    with closing(port.socket):
        stranger.sendto(b"hello", port.local)
        assert take(port, 100 * LATCH_SILENCE_NS) == b""
        peer.sendto(b"plain", port.local)
        assert take(port, 200 * LATCH_SILENCE_NS) == b"plain"
        assert port.peer == peer.getsockname()


def test_without_a_peer_nothing_is_sent_but_counted():
    port = listen("p", HOME, accept=accept_hello)
    with closing(port.socket):
        port.send(b"x")
        assert port.unsent == 1


def test_an_empty_datagram_is_dropped_and_the_next_one_served(peer):
    port = listen("p", HOME, accept=accept_hello)
    node = Probe()
    with closing(UdpDriver(node, [port], Clock())) as driver:
        for datagram in (b"hello", b"", b"next"):
            peer.sendto(datagram, port.local)
        driver.run(until(lambda: len(node.got) >= 2))
        assert [datagram for _, datagram, _ in node.got] == [b"hello", b"next"]


def test_a_busy_port_is_refused_by_its_address(peer):
    host, number = peer.getsockname()
    with pytest.raises(InputError, match=rf"address 127\.0\.0\.1:{number}: .*in use"):
        listen("p", (host, number))


def test_an_address_that_is_not_ours_is_refused():
    with pytest.raises(InputError, match=r"address 192\.0\.2\.1:5"):
        listen("p", ("192.0.2.1", 5))


@pytest.mark.parametrize("open_port", [dial, listen])
def test_an_address_that_cannot_be_resolved_is_refused(monkeypatch, open_port):
    def nobody_knows(*_args, **_more):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", nobody_knows)
    with pytest.raises(InputError, match=r"address host\.invalid:14600: cannot be resolved"):
        open_port("p", ("host.invalid", 14600))


@pytest.mark.parametrize("host", ["a" * 70 + ".invalid", "a..b"])
def test_a_host_name_that_is_none_is_refused(host):
    with pytest.raises(InputError, match="cannot be resolved"):
        dial("p", (host, 14600))


# the driver


def test_a_peer_that_is_not_there_does_not_end_the_driver(peer):
    node = Probe(deadline_ns=0, beacon=[("p", b"anybody?")])
    with deaf() as nobody:
        peer.connect(nobody.getsockname())
        peer.send(b"anybody?")
        with pytest.raises(ConnectionRefusedError):
            peer.recv(99)
        with closing(UdpDriver(node, [dial("p", nobody.getsockname())], Clock())) as driver:
            driver.run(passes(50))
    assert len(node.ticks) == 50
    assert node.got == []


def test_a_peer_that_comes_later_is_served():
    node = Probe(deadline_ns=0, beacon=[("p", b"anybody?")])
    with deaf() as late:
        port = dial("p", late.getsockname())
        with closing(UdpDriver(node, [port], Clock())) as driver:
            driver.run(passes(5))
            late.connect(port.local)
            driver.run(passes(5))
            assert late.recv(99) == b"anybody?"
            late.send(b"here")
            driver.run(until(lambda: bool(node.got)))
    assert [datagram for _, datagram, _ in node.got] == [b"here"]


class FailingSocket:
    """A socket whose next reading reports what an ICMP message said about an earlier datagram."""

    def __init__(self, code: int, sock: socket.socket) -> None:
        self._codes = [code]
        self._sock = sock

    def __getattr__(self, name):
        if self._codes and name.startswith("recv"):
            raise OSError(code := self._codes.pop(), errno.errorcode[code])
        return getattr(self._sock, name)


@pytest.mark.parametrize(
    "code", [errno.ECONNREFUSED, errno.ECONNRESET, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN]
)
def test_no_word_from_the_network_about_a_peer_ends_the_driver(peer, code):
    port = dial("p", peer.getsockname())
    with closing(port.socket) as sock:
        peer.sendto(b"after", port.local)
        port.socket = FailingSocket(code, sock)
        select.select([sock], [], [], TIMEOUT_S)
        assert port.receive(0) == b""
        assert port.receive(0) == b"after"
        port.socket = sock


def test_a_flood_on_one_port_does_not_keep_the_control_port_waiting(peer, stranger):
    control, flooded = listen("control", HOME, accept=bool), listen("flooded", HOME, accept=bool)
    node = Probe(deadline_ns=0)
    for _ in range(100):
        stranger.sendto(b"flood", flooded.local)

    def each(_number: int) -> None:
        peer.sendto(b"control", control.local)

    with closing(UdpDriver(node, [control, flooded], Clock())) as driver:
        driver.run(passes(4, each))
    assert [port for port, _, _ in node.got] == ["control", "flooded"] * 4
    assert len(node.ticks) == 4


def test_what_a_full_receive_buffer_drops_is_counted(peer):
    port = listen("p", HOME, accept=bool)
    with closing(port.socket):
        room = port.socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        sent = 2 * room // BIG_BYTES
        for _ in range(sent):
            peer.sendto(bytes(BIG_BYTES), port.local)
        taken = sum(1 for _ in iter(lambda: port.receive(0), None))
        assert 0 < taken < sent
        assert port.overflowed == sent - taken


def test_what_the_kernel_does_not_tell_is_unknown_and_not_zero(peer):
    port = dial("p", peer.getsockname())
    port.socket.close()
    assert port.overflowed is None


# the order of service, in virtual time


@dataclass
class Queue:
    """A port without a socket: what comes when."""

    name: str
    coming: deque[tuple[int, bytes]]
    socket: None = None
    stamps: bool = False

    def ready(self, now_ns: int) -> bool:
        return bool(self.coming) and self.coming[0][0] <= now_ns

    def receive(self, now_ns: int) -> bytes | None:
        return self.coming.popleft()[1] if self.ready(now_ns) else None


@dataclass
class World:
    """Queues, a driver, and a node for which all work takes time; the log says what was done and when it began."""

    queues: list[Queue]
    control: int = 1
    period_ns: int = TICK_PERIOD_NS
    now_ns: int = 0
    log: list[tuple[str, bytes, int]] = field(default_factory=list)
    due_ns: int = 0

    def receive(self, port, datagram, now_ns):
        self.log.append((port, datagram, now_ns))
        self.now_ns += COST_NS["control" if port.startswith("control") else "ground"]

    def tick(self, now_ns):
        self.log.append(("tick", b"%d" % self.due_ns, now_ns))
        self.due_ns += self.period_ns
        self.now_ns += COST_NS["tick"]

    def next_deadline_ns(self):
        return self.due_ns

    def outgoing(self):
        return []

    def records(self):
        return []

    def fly(self, monkeypatch: pytest.MonkeyPatch, passes: int | None = None) -> None:
        """Make passes, until nothing is left to come."""
        monkeypatch.setattr(udp, "true_ns", lambda: self.now_ns)
        driver = UdpDriver(self, self.queues, Clock(), control=self.control)
        for made in itertools.count():
            if made == passes or not any(queue.coming for queue in self.queues):
                return
            if not any(queue.ready(self.now_ns) for queue in self.queues):
                self.now_ns = min(self.due_ns, *(queue.coming[0][0] for queue in self.queues if queue.coming))
            driver.serve([queue for queue in self.queues if queue.ready(self.now_ns)])

    def served(self) -> list[str]:
        return [port for port, _, _ in self.log if port != "tick"]


def waiting(name: str, count: int) -> Queue:
    return Queue(name, deque((0, b"waits") for _ in range(count)))


def every(name: str, period_ns: int, count: int) -> Queue:
    """Return a queue to which a datagram comes each period; it holds the time of its coming."""
    return Queue(name, deque((i * period_ns, b"%d" % (i * period_ns)) for i in range(count)))


def test_a_control_datagram_waits_for_one_ground_datagram_and_one_tick_at_the_most(monkeypatch):
    world = World([every("control", SAMPLE_NS, 12), waiting("gcs0", 10_000)])
    world.fly(monkeypatch)
    assert world.served()[0] == "control"
    assert world.served().count("gcs0") == 10_000
    comings = [i for i, (port, _, _) in enumerate(world.log) if port == "control"]
    assert len(comings) == 12
    for i in comings:
        _, came, began_ns = world.log[i]
        assert 0 <= began_ns - int(came) < COST_NS["ground"] + COST_NS["tick"]
        between = [port for port, _, ns in world.log[:i] if ns > int(came)]
        assert between.count("gcs0") + between.count("tick") <= 1


def test_what_is_due_waits_for_one_ground_datagram_and_what_control_has_at_the_most(monkeypatch):
    world = World([every("control", SAMPLE_NS, 12), waiting("gcs0", 10_000)])
    world.fly(monkeypatch)
    ticks = [(int(due), began_ns) for port, due, began_ns in world.log if port == "tick"]
    assert [due_ns for due_ns, _ in ticks] == [i * TICK_PERIOD_NS for i in range(len(ticks))]
    assert ticks[-1][0] > 10_000 * COST_NS["ground"]
    worst_ns = max(began_ns - due_ns for due_ns, began_ns in ticks)
    assert 0 < worst_ns <= 2 * COST_NS["ground"] + COST_NS["control"]


def test_ground_stations_are_served_in_turn(monkeypatch):
    world = World([waiting("gcs0", 10_000), waiting("gcs1", 3), waiting("gcs2", 1), waiting("gcs3", 2)], control=0)
    world.fly(monkeypatch)
    assert world.served()[:10] == ["gcs0", "gcs1", "gcs2", "gcs3", "gcs0", "gcs1", "gcs3", "gcs0", "gcs1", "gcs0"]
    assert set(world.served()[10:]) == {"gcs0"}


def test_a_station_that_speaks_now_and_then_waits_for_one_datagram_of_each_other(monkeypatch):
    world = World([every("gcs0", SAMPLE_NS, 12), waiting("gcs1", 10_000), waiting("gcs2", 10_000)], control=0)
    world.fly(monkeypatch)
    waits = [began_ns - int(came) for port, came, began_ns in world.log if port == "gcs0"]
    assert len(waits) == 12
    assert max(waits) <= 3 * COST_NS["ground"] + COST_NS["tick"]


def test_a_flood_at_the_control_port_itself_starves_neither_ground_nor_what_is_due(monkeypatch):
    world = World([waiting("control", 10_000), waiting("gcs0", 10_000)], period_ns=1)
    world.fly(monkeypatch, passes=5)
    one_pass = ["control"] * MAX_PER_PASS + ["gcs0", "tick"]
    assert [what for what, _, _ in world.log] == one_pass * 5


def test_every_control_port_comes_before_any_other(monkeypatch):
    world = World([waiting("control0", 2), waiting("control1", 2), waiting("gcs0", 2), waiting("gcs1", 1)], control=2)
    world.fly(monkeypatch)
    assert world.served() == ["control0"] * 2 + ["control1"] * 2 + ["gcs0", "gcs1", "gcs0"]


@pytest.mark.parametrize("count", range(5))
def test_the_next_in_turn_is_the_first_that_is_ready_of_all_in_order_after_the_last(count):
    for ready in itertools.product((False, True), repeat=count):
        for last in range(-1, count):
            order = [*range(last + 1, count), *range(last + 1)]
            assert next_in_turn(ready, last) == next((i for i in order if ready[i]), None)


class Stamped(Queue):
    """A queue that knows when its datagrams came."""

    came = 0

    def receive(self, now_ns: int) -> bytes | None:
        self.came = self.coming[0][0] if self.ready(now_ns) else now_ns
        return super().receive(now_ns)

    def came_ns(self, _now_ns: int) -> int:
        return self.came


def test_a_node_is_told_when_a_datagram_came_and_does_what_is_due_at_the_time_that_it_is(monkeypatch):
    control_ns = COST_NS["control"]
    queue = Stamped("control", deque([(-9, b"a"), (-7, b"b")]), stamps=True)  # both wait since before the start
    world = World([queue], period_ns=NS_PER_S)
    world.fly(monkeypatch)
    assert world.log == [("control", b"a", -9), ("tick", b"0", control_ns), ("control", b"b", -7)]


# sleeping and spinning, in virtual time

LATE_NS = 60 * NS_PER_US
"""How late a sleep ends."""
LOOK_NS = 2 * NS_PER_US
IDLE_TAKES_NS = 80 * NS_PER_US
SPIN_NS = 300 * NS_PER_US


@dataclass
class Sleeper(Probe):
    """A node that is due periodically, in a system whose sleeps end late."""

    period_ns: int = SAMPLE_NS
    now_ns: int = 0
    comes_ns: int = 1 << 62
    """When there is a datagram."""
    sleeps: list[tuple[int, int]] = field(default_factory=list)
    spun_ns: int = 0
    late_ns: list[int] = field(default_factory=list)

    def tick(self, now_ns):
        self.late_ns.append(now_ns - self.deadline_ns)
        self.deadline_ns += self.period_ns

    def select(self, numbers, _writing, _failing, wait_s):
        wait_ns = round(wait_s * NS_PER_S)
        if wait_ns:
            self.sleeps.append((self.now_ns, wait_ns))
            self.now_ns += wait_ns + LATE_NS
        else:
            self.spun_ns += LOOK_NS
            self.now_ns += LOOK_NS
        came = self.now_ns >= self.comes_ns
        self.comes_ns = 1 << 62 if came else self.comes_ns
        return list(numbers) if came else [], [], []

    def run(
        self,
        monkeypatch: pytest.MonkeyPatch,
        peer: socket.socket,
        passes_made: int,
        spin_ns: int = 0,
        *,
        busy: bool = False,
        idle: Callable[[], None] | None = None,
    ) -> None:
        """Make passes; a datagram waits in the socket until its time has come."""
        self.deadline_ns = self.period_ns
        port = dial("p", peer.getsockname())
        peer.sendto(b"x", port.local)
        monkeypatch.setattr(udp, "true_ns", lambda: self.now_ns)
        monkeypatch.setattr(select, "select", self.select)
        with closing(UdpDriver(self, [port], Clock(), spin_ns=spin_ns, busy=busy, idle=idle)) as driver:
            driver.run(passes(passes_made))


def test_a_driver_that_sleeps_to_the_deadline_is_as_late_as_its_sleep(monkeypatch, peer):
    node = Sleeper()
    node.run(monkeypatch, peer, 5, spin_ns=0)
    assert node.late_ns == [LATE_NS] * 5
    assert node.spun_ns == 0


def test_a_driver_that_spins_sleeps_until_then_and_is_as_late_as_one_look(monkeypatch, peer):
    node = Sleeper()
    node.run(monkeypatch, peer, 5, spin_ns=SPIN_NS)
    assert len(node.late_ns) == len(node.sleeps) == 5
    assert all(0 <= late_ns < LOOK_NS for late_ns in node.late_ns)
    for n, (begin_ns, wait_ns) in enumerate(node.sleeps, 1):
        assert begin_ns + wait_ns == n * SAMPLE_NS - SPIN_NS
    assert SPIN_NS - LATE_NS <= node.spun_ns / 5 <= SPIN_NS - LATE_NS + LOOK_NS


def test_a_datagram_that_comes_while_it_spins_is_served_at_once(monkeypatch, peer):
    comes_ns = SAMPLE_NS - SPIN_NS // 2
    node = Sleeper(comes_ns=comes_ns)
    node.run(monkeypatch, peer, 2, spin_ns=SPIN_NS)
    ((_, datagram, now_ns),) = node.got
    assert datagram == b"x"
    assert comes_ns <= now_ns < comes_ns + LOOK_NS
    assert len(node.sleeps) == 1  # it spins on, up to the deadline
    assert [0 <= late_ns < LOOK_NS for late_ns in node.late_ns] == [True]


def test_a_driver_does_not_spin_for_a_deadline_that_is_further_than_its_longest_sleep(monkeypatch, peer):
    node = Sleeper(period_ns=10 * MAX_WAIT_NS)
    node.run(monkeypatch, peer, 5, spin_ns=SPIN_NS)
    assert [wait_ns for _, wait_ns in node.sleeps] == [MAX_WAIT_NS] * 5
    assert node.spun_ns == 0


@pytest.mark.parametrize("spin_ns", [SPIN_NS, MAX_SPIN_NS])
def test_spinning_takes_no_more_than_its_share_of_the_time(monkeypatch, peer, spin_ns):
    node = Sleeper(period_ns=110 * NS_PER_US)
    node.run(monkeypatch, peer, 3000, spin_ns=spin_ns)
    assert node.now_ns > 10 * MAX_SPIN_NS
    assert node.spun_ns <= node.now_ns / SPIN_SHARE + MAX_SPIN_NS + LOOK_NS
    assert node.sleeps


def test_a_busy_driver_never_sleeps_and_serves_a_datagram_at_once(monkeypatch, peer):
    node = Sleeper(comes_ns=SAMPLE_NS // 2)
    node.run(monkeypatch, peer, 6, busy=True)
    ((_, datagram, now_ns),) = node.got
    assert datagram == b"x"
    assert SAMPLE_NS // 2 <= now_ns < SAMPLE_NS // 2 + LOOK_NS
    assert node.sleeps == []
    assert all(0 <= late_ns < LOOK_NS for late_ns in node.late_ns)


def test_a_busy_driver_without_a_deadline_soon_sees_that_it_shall_stop(monkeypatch, peer):
    node = Sleeper(period_ns=10 * MAX_WAIT_NS)
    node.run(monkeypatch, peer, 2, busy=True)
    assert node.sleeps == []
    assert 2 * MAX_WAIT_NS <= node.now_ns <= 2 * (MAX_WAIT_NS + LOOK_NS)


def test_a_busy_driver_has_something_to_do_while_nothing_comes(monkeypatch, peer):
    node, began_ns = Sleeper(comes_ns=SAMPLE_NS // 2), []

    def idle():
        began_ns.append(node.now_ns)
        node.now_ns += IDLE_TAKES_NS

    node.run(monkeypatch, peer, 6, busy=True, idle=idle)
    pauses_ns = [after - before - IDLE_TAKES_NS for before, after in itertools.pairwise(began_ns)]
    assert len(began_ns) > 5 * SAMPLE_NS // (IDLE_NS + IDLE_TAKES_NS + LOOK_NS) - 6
    assert min(pauses_ns) >= IDLE_NS
    assert max(pauses_ns) <= IDLE_NS + 2 * LOOK_NS
    ((_, _, now_ns),) = node.got
    assert now_ns - SAMPLE_NS // 2 <= IDLE_TAKES_NS + LOOK_NS
    assert max(node.late_ns) <= IDLE_TAKES_NS + LOOK_NS


@pytest.mark.parametrize("spin_ns", [0, SPIN_NS])
def test_a_driver_that_is_not_busy_is_never_idle(monkeypatch, peer, spin_ns):
    calls = []
    Sleeper().run(monkeypatch, peer, 5, spin_ns=spin_ns, idle=lambda: calls.append(1))
    assert calls == []


# what the node lives on


def test_answers_leave_and_the_driver_stops_when_told(peer):
    port = listen("p", HOME, accept=bool)
    node = Probe(echo=True)
    with closing(UdpDriver(node, [port], Clock())) as driver:
        peer.sendto(b"ping", port.local)
        driver.run(until(lambda: bool(node.got)))
        assert peer.recv(99) == b"ping"


def test_the_node_lives_on_its_own_clock_from_the_boot_of_its_driver(peer, monkeypatch):
    now = 50 * NS_PER_S
    monkeypatch.setattr(udp, "true_ns", lambda: now)
    node = Probe(deadline_ns=0)
    port = listen("p", HOME, accept=bool)
    with closing(UdpDriver(node, [port], Clock(137 * NS_PER_S, 100_000))) as driver:
        now += 10 * NS_PER_S
        peer.sendto(b"x", port.local)
        select.select([port.socket], [], [], TIMEOUT_S)
        driver.run(passes(1))
    assert node.ticks == [147 * NS_PER_S + 1_000_000]
    assert node.got == [("p", b"x", 147 * NS_PER_S + 1_000_000)]


def test_a_tick_is_never_early(peer):
    node = Probe(deadline_ns=20_000_000)
    with closing(UdpDriver(node, [dial("p", peer.getsockname())], Clock())) as driver:
        driver.run(until(lambda: bool(node.ticks)))
        assert driver.clock.node_ns(true_ns()) >= node.ticks[0] >= node.deadline_ns


@dataclass
class Sink:
    records: list[tuple[Record, int]] = field(default_factory=list)
    pumped: int = 0

    def write(self, record, log_time_ns):
        self.records.append((record, log_time_ns))

    def pump(self):
        self.pumped += 1


@pytest.mark.parametrize("tap", [False, True])
def test_records_are_filed_at_true_time_and_datagrams_with_the_tap_only(peer, tap):
    before = true_ns()
    sink, node = Sink(), Probe(deadline_ns=0, echo=True)
    port = listen("p", HOME, accept=bool)
    with closing(UdpDriver(node, [port], Clock(9 * NS_PER_S), sink, tap=tap)) as driver:
        peer.sendto(b"ping", port.local)
        driver.run(passes(2))
    by_time = sorted(sink.records, key=lambda record: record[1])
    frames = [r.body["direction"] for r, _ in by_time if r.topic == "mavlink/p"]
    assert frames == (["received", "sent"] if tap else [])
    assert sum(r.topic == "events" for r, _ in sink.records) == len(node.ticks) == sink.pumped == 2
    assert all(before <= at_ns <= true_ns() for _, at_ns in sink.records)
