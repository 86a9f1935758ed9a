"""The bus: stages hand messages to one another over zenoh, between processes; without any endpoint, inside one.

Nothing is scouted, and nothing listens unless it is named. Below ``sortie/{sortie}/``:

==============================================  ======================================================================
``{stage}/{vehicle}/{family}/{stream}``         what a stage says: who speaks first, so that a consumer subscribes to
                                                a stage, and an access list can tie a stage to a certificate
``history/{stage}/{instance}?from=N;to=M``      what it has said so far (a query), from its disk
``ack/{service}/{stage}``                       what a consumer has processed (a query)
``alive/{session}/{stage}/{instance}/{lineage}``  liveliness of a publisher, gone with its process
``listening/{session}/{service}/{stage}``       liveliness of a subscription
==============================================  ======================================================================

**Nothing is lost.** A stage numbers its output (`Message.sequence`) without gaps over all its streams, and keeps all
of it in a spool on disk. A consumer puts the streams together again in that order; what it missed, because it came
late or its link was down, it reads in the history. What cannot be had there is reported as missing, never skipped in
silence. At the end a publisher waits until every consumer has processed the last message, because closing a session
does not drain it.

**Nothing is mixed.** Every run of a stage has an instance, and says which runs of other stages it is made from. When a
stage is restarted, what was made from its old run is void: its consumers begin anew, from its first message, and so do
theirs (`Subscription.lives`, `serve`). So a recording is always one run of everything, from the beginning.

Zenoh's own advanced publishers and subscribers are not used. They number each key by itself and recover from a cache
in memory, which is shorter than the outages to be survived. Beside the spool they would do nothing that is not done
already, for up to 40 % more CPU per message at the consumer (1 to 5 thousand messages a second), and would need a
second set of access rules (``@adv``).

================================  ===================  ================  ==============================================
traffic                           congestion           priority          why
================================  ===================  ================  ==============================================
all that a stage numbers          BLOCK, for `block`   DATA_HIGH         one order over all its streams: a stream that
                                  seconds, then the                      overtakes the others only waits for them
                                  link is dropped
history                           BLOCK                DATA_LOW          catching up must not delay what is new
acknowledgements, questions       BLOCK                DATA (default)    small and rare
health                            DROP                 DATA_LOW          the next row comes in a second
================================  ===================  ================  ==============================================

Who is behind measures it: the age of data at every consumer is published each second as `Health`, and alarms.
"""

from telemetry.bus.publisher import DRAIN, Publisher
from telemetry.bus.session import Bus, chunk
from telemetry.bus.stages import Replaced, publish, serve
from telemetry.bus.subscription import Life, Subscription

__all__ = ["DRAIN", "Bus", "Life", "Publisher", "Replaced", "Subscription", "chunk", "publish", "serve"]
