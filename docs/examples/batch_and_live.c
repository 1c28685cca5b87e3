/* Store a batch and show a live sample: batch_and_live HOST PORT ROBOT FOLDER AUTHORITIES
   cc batch_and_live.c -o batch_and_live -lpaho-mqtt3cs -lcrypto -lz */
#include <MQTTClient.h>
#include <openssl/evp.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#include <zlib.h>

static MQTTClient client;

static int publish(const char *rule, const char *lane, const char *robot, const char *message, int qos) {
  char topic[256];
  MQTTClient_deliveryToken token;
  snprintf(topic, sizeof topic, "%s%s/iort/%s/arm", rule, lane, robot);
  return MQTTClient_publish(client, topic, strlen(message), message, qos, 0, &token) ||
         MQTTClient_waitForCompletion(client, token, 9000);
}

int main(int argc, char **argv) {
  char address[300], certificate[300], key[300], run[17], batch[600], live[300];
  const char *columns = "{\"dt\":[0,20000],\"fields\":{\"angle\":[null,0.5,1.5]}}";
  unsigned char packed[200], samples[400];
  uLongf size = sizeof packed;
  struct timespec now;
  if (argc != 6) return 2;
  const char *robot = argv[3];
  snprintf(address, sizeof address, "ssl://%s:%s", argv[1], argv[2]);
  snprintf(certificate, sizeof certificate, "%s/certificate.pem", argv[4]);
  snprintf(key, sizeof key, "%s/private.key", argv[4]);
  MQTTClient_SSLOptions tls = MQTTClient_SSLOptions_initializer;
  tls.trustStore = argv[5], tls.keyStore = certificate, tls.privateKey = key;
  MQTTClient_connectOptions options = MQTTClient_connectOptions_initializer;
  options.ssl = &tls, options.MQTTVersion = MQTTVERSION_3_1_1;
  if (MQTTClient_create(&client, address, robot, MQTTCLIENT_PERSISTENCE_NONE, NULL) ||
      MQTTClient_connect(client, &options)) return 1;

  clock_gettime(CLOCK_REALTIME, &now);
  long long us = now.tv_sec * 1000000LL + now.tv_nsec / 1000;
  snprintf(run, sizeof run, "%016llx", us * 1000LL + now.tv_nsec % 1000);
  compress(packed, &size, (const Bytef *)columns, strlen(columns));
  EVP_EncodeBlock(samples, packed, size);
  snprintf(batch, sizeof batch, "{\"v\":2,\"batch\":\"%016lld-%s-0\",\"n\":2,\"codec\":\"steps\",\"samples\":\"%s\"}",
           us, run, samples);
  snprintf(live, sizeof live, "{\"v\":1,\"boot\":\"%s\",\"seq\":0,\"t\":%lld,\"sent_us\":%lld,\"nonfinite\":0,"
           "\"sample\":{\"angle\":1.5}}", run, us, us);
  if (publish("$aws/rules/iort_record/", "dt", robot, batch, 1) || publish("", "live", robot, live, 0)) return 1;
  return MQTTClient_disconnect(client, 9000);
}
