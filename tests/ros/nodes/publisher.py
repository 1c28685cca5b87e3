"""A rospy publisher of a made-up type, in its own process: `publisher.py NAME TOPIC TYPE DEFINITION ...`.

It sends values of ``field`` that count up; see `testkit.publishing.count`.
"""

from pathlib import Path

import genpy.dynamic
import rospy

from testkit.publishing import count, counter_options

parser = counter_options()
parser.add_argument("definition", help="file with the full text of the definition")
options = parser.parse_args()

text = Path(options.definition).read_text()
Class = genpy.dynamic.generate_dynamic(options.type, text)[options.type]
rospy.init_node(options.name, disable_signals=True)
publisher = rospy.Publisher(options.topic, Class, queue_size=1000, tcp_nodelay=True, latch=options.latch)
count(Class(), options, publisher.get_num_connections, publisher.publish)
rospy.signal_shutdown("done")
