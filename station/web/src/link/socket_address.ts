// Where a page connects to AWS IoT: an address that is signed for one connection, by the page's server or, on a static
// site, by everybody's identity.

import { AwsV4Signer } from "aws4fetch";
import type { Identity, SocketAnswer } from "../base/contract";
import { AnswerError, ask } from "../server/answers";

// AWS refuses an older signature.
const SIGNED_S = 300;
const SERVICE = "iotdevicegateway";

/** A new address; throws `AnswerError`. */
export const socketAddress = (identity: Identity | null): Promise<SocketAnswer> =>
  identity ? byIdentity(identity) : ask<SocketAnswer>("socket", {});

interface Credentials {
  readonly AccessKeyId: string;
  readonly SecretKey: string;
  readonly SessionToken: string;
}

async function byIdentity(identity: Identity): Promise<SocketAnswer> {
  const { pool, region, socket, client_prefix } = identity;
  const { IdentityId } = await cognito<{ readonly IdentityId: string }>(identity, "GetId", {
    IdentityPoolId: pool,
  });
  const { Credentials: got } = await cognito<{ readonly Credentials: Credentials }>(
    identity,
    "GetCredentialsForIdentity",
    { IdentityId },
  );
  const url = new URL(socket);
  url.searchParams.set("X-Amz-Expires", String(SIGNED_S));
  const signer = new AwsV4Signer({
    url: url.href,
    accessKeyId: got.AccessKeyId,
    secretAccessKey: got.SecretKey,
    sessionToken: got.SessionToken,
    service: SERVICE,
    region,
    signQuery: true,
  });
  return {
    url: (await signer.sign()).url.href,
    client_id: `${client_prefix}${crypto.randomUUID().replaceAll("-", "").slice(0, 16)}`,
  };
}

async function cognito<T>({ endpoint }: Identity, action: string, body: object): Promise<T> {
  const headers = {
    "Content-Type": "application/x-amz-json-1.1",
    "X-Amz-Target": `AWSCognitoIdentityService.${action}`,
  };
  let answer: Response;
  try {
    answer = await fetch(endpoint, { method: "POST", headers, body: JSON.stringify(body) });
  } catch {
    throw new AnswerError("Amazon Cognito cannot be reached");
  }
  if (!answer.ok) throw new AnswerError(`Amazon Cognito refuses this page an identity (${answer.status})`);
  return (await answer.json()) as T;
}
