import jade.core.AID;
import jade.core.Agent;
import jade.core.behaviours.OneShotBehaviour;
import jade.lang.acl.ACLMessage;
import jade.lang.acl.MessageTemplate;

/** Sends requests to an agent of another platform and waits for each reply: name, address, number, bytes. */
public class AskAgent extends Agent {
    @Override
    protected void setup() {
        final Object[] arguments = getArguments();
        addBehaviour(new OneShotBehaviour(this) {
            @Override
            public void action() {
                myAgent.doWait(6000);
                AID to = new AID((String) arguments[0], AID.ISGUID);
                to.addAddresses((String) arguments[1]);
                int number = Integer.parseInt((String) arguments[2]);
                int bytes = Integer.parseInt((String) arguments[3]);
                StringBuilder content = new StringBuilder();
                for (int i = 0; i < bytes; i++) {
                    content.append('x');
                }
                long[] nanos = new long[number];
                int lost = 0;
                for (int i = 0; i < number; i++) {
                    ACLMessage request = new ACLMessage(ACLMessage.REQUEST);
                    request.addReceiver(to);
                    request.setContent(content.toString());
                    request.setConversationId("c" + i);
                    request.setReplyWith("r" + i);
                    long began = System.nanoTime();
                    myAgent.send(request);
                    ACLMessage reply = myAgent.blockingReceive(MessageTemplate.MatchInReplyTo("r" + i), 10000);
                    nanos[i] = System.nanoTime() - began;
                    if (reply == null || reply.getPerformative() == ACLMessage.FAILURE) {
                        lost++;
                        System.out.println("asked " + i + ": " + reply);
                    } else if (i == 0) {
                        System.out.println("first reply: " + reply);
                    }
                }
                java.util.Arrays.sort(nanos);
                double mean = java.util.Arrays.stream(nanos).average().orElse(0) / 1000.0;
                double variance = java.util.Arrays.stream(nanos).mapToDouble(n -> n / 1000.0 - mean).map(d -> d * d).average().orElse(0);
                ACLMessage other;
                int surplus = 0;
                while ((other = myAgent.receive()) != null) {
                    surplus++;
                    System.out.println("surplus: " + other);
                }
                System.out.printf("ASKED %d lost %d surplus %d median_us %.1f mean_us %.1f deviation_us %.1f%n", number, lost, surplus,
                        nanos[number / 2] / 1000.0, mean, Math.sqrt(variance));
            }
        });
    }
}
