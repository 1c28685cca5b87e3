// Subscribes with PubNub's JavaScript SDK and prints what happens, one JSON value a line:
// node pubnub_subscriber.cjs <folder of the package> <origin> <channel> <how many messages>
const [folder, origin, channel, count] = process.argv.slice(2);
const PubNub = require(folder);

const print = (value) => console.log(JSON.stringify(value));
const pubnub = new PubNub({
  publishKey: "pub",
  subscribeKey: "sub",
  userId: "page",
  origin,
  ssl: false,
  retryConfiguration: PubNub.LinearRetryPolicy({ delay: 2, maximumRetry: 10 }),
});

let left = Number(count);
pubnub.addListener({
  status: (status) => print({ status: status.category }),
  message: (event) => {
    print({ channel: event.channel, subscription: event.subscription, message: event.message });
    left -= 1;
    if (left === 0) {
      pubnub.destroy();
      process.exit(0);
    }
  },
});
pubnub.subscribe({ channels: [channel] });
